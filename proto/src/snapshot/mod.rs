//! Snapshots of indices: [`Writer`] makes the parts, [`Reader`] checks them, and [`FileWriter`] and [`FileReader`] keep
//! them in files.
//!
//! The format is documented in `wayfold/v1/snapshot.proto`. Each program that takes, keeps or restores a snapshot
//! checks all of it here, and does not rely on the checks of the program before it.

mod entries;
mod error;
mod file;
mod reader;
mod sessions;
mod writer;

use std::io::Read;

use sha2::{Digest as _, Sha256};
use wayfold_index::Space;

use crate::v1::PayloadEncoding;

pub use error::{BlockProblem, PointPosition, PointProblem, SessionProblem, SnapshotError};
pub use file::{FileReader, FileWriter};
pub use reader::{Content, Reader};
pub use writer::Writer;

/// The version of the format.
pub const FORMAT_VERSION: u32 = 3;

/// The oldest version that is read. It has no writer sessions.
pub const OLDEST_FORMAT_VERSION: u32 = 2;

/// The most bytes of a part's content.
pub const MAX_CONTENT_BYTES: usize = 4 * 1024 * 1024;

/// The most bytes of a point's payload.
pub const MAX_PAYLOAD_BYTES: usize = 64 * 1024;

/// A SHA-256.
pub type Digest = [u8; 32];

/// The facts that a snapshot states before its points.
#[derive(Clone, Debug, PartialEq)]
pub struct Header {
    /// The name that the index had.
    pub name: String,
    /// The uid that the index had.
    pub uid: String,
    /// The space of its states.
    pub space: Space,
    /// How its payloads hold edges.
    pub payload_encoding: PayloadEncoding,
    /// The revision that was read.
    pub revision: u64,
    /// The least id above every id that the index ever used or reserved.
    pub next_id: u64,
    /// The number of points that follow.
    pub point_count: u64,
}

/// Reads a file from its first byte to its last, checks all of it, and returns its header.
///
/// # Errors
/// The file is not a whole snapshot of a known version, or cannot be read.
pub fn check(file: impl Read) -> Result<Header, SnapshotError> {
    let mut file = FileReader::new(file)?;
    let mut header = None;
    while let Some((_, content)) = file.next_part()? {
        if let Content::Header(found) = content {
            header = Some(found);
        }
    }
    header.ok_or(SnapshotError::CutShort { parts: 0 })
}

/// The digest of a part, after one of the digest `before`.
fn digest(before: &Digest, number: u64, content: &[u8]) -> Digest {
    Sha256::new()
        .chain_update(before)
        .chain_update(number.to_le_bytes())
        .chain_update(content)
        .finalize()
        .into()
}
