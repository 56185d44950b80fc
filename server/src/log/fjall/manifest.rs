//! Whether the store's lists of its tables are what it wrote. fjall 3 does not look itself: a damaged one makes it panic,
//! even to the end of the process, or take tables for leftovers that are to be removed.
//!
//! Each tree of the store, a directory in `keyspaces`, has its lists in files `v0`, `v1` and so on, and a file `current`
//! of 25 bytes: the number of the list that counts (u64), the XXH3 of that file (128 bits), and 0 for the kind of this
//! checksum. Numbers are little-endian.

use std::{fs, io, path::Path};

use xxhash_rust::xxh3::xxh3_128;

use super::store::{not_readable, shut};
use crate::log::{LogError, cursor::Cursor};

/// Fails if the lists of a store are damaged, or the disk does not let them be read, before it is opened.
pub(super) fn check(store: &Path) -> Result<(), LogError> {
    let trees = store.join("keyspaces");
    let unreadable = |path: &Path, error| match shut(error) {
        LogError::Shut { what } => LogError::Shut {
            what: format!("{}: {what}", path.display()),
        },
        _ => not_readable(format!("{} is missing", path.display())),
    };
    let damaged = |path: &Path| not_readable(format!("{} is damaged", path.display()));
    for tree in fs::read_dir(&trees).map_err(|error| unreadable(&trees, error))? {
        let tree = tree.map_err(|error| unreadable(&trees, error))?.path();
        let path = tree.join("current");
        let current = match fs::read(&path) {
            Ok(current) => current,
            // A tree that was not finished: the store removes it.
            Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
            Err(error) => return Err(unreadable(&path, error)),
        };
        let (number, sum) = decode(&current).ok_or_else(|| damaged(&path))?;
        let path = tree.join(format!("v{number}"));
        let list = fs::read(&path).map_err(|error| unreadable(&path, error))?;
        if xxh3_128(&list).to_le_bytes() != sum {
            return Err(damaged(&path));
        }
    }
    Ok(())
}

fn decode(current: &[u8]) -> Option<(u64, [u8; 16])> {
    let mut cursor = Cursor::new(current);
    let (number, sum, kind) = (cursor.u64()?, cursor.array()?, cursor.array()?);
    (kind == [0] && cursor.is_empty()).then_some((number, sum))
}
