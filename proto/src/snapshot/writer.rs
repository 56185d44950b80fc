//! Encodes the parts of a snapshot.

use prost::Message;

use super::{Digest, FORMAT_VERSION, Header, digest};
use crate::{
    space,
    v1::{self, snapshot_content::Kind},
};

/// Makes the parts of one snapshot, in order.
///
/// The caller is responsible for their contents. A [`Reader`](super::Reader) checks them.
#[derive(Clone, Debug, Default)]
pub struct Writer {
    parts: u64,
    trailer: v1::SnapshotTrailer,
    digest: Digest,
}

impl Writer {
    /// Begins a snapshot.
    pub fn new() -> Writer {
        Writer::default()
    }

    /// The first part.
    pub fn header(&mut self, header: &Header) -> v1::SnapshotPart {
        self.part(Kind::Header(v1::SnapshotHeader {
            format_version: FORMAT_VERSION,
            name: header.name.clone(),
            space: Some(space::to_message(&header.space)),
            space_text: header.space.to_string(),
            next_id: header.next_id,
            point_count: header.point_count,
            payload_encoding: header.payload_encoding.into(),
            revision: Some(v1::Revision {
                uid: header.uid.clone(),
                number: header.revision,
            }),
        }))
    }

    /// A part of points, with ids above all before.
    pub fn points(&mut self, points: v1::SnapshotPoints) -> v1::SnapshotPart {
        self.trailer.point_count += points
            .points
            .as_ref()
            .map_or(0, |points| points.ids.len() as u64);
        self.part(Kind::Points(points))
    }

    /// The number of points.
    pub fn points_written(&self) -> u64 {
        self.trailer.point_count
    }

    /// A part of writer sessions and blocks of reserved ids, after all points.
    pub fn sessions(&mut self, sessions: v1::SnapshotSessions) -> v1::SnapshotPart {
        self.trailer.session_count += sessions.sessions.len() as u64;
        self.trailer.block_count += sessions.blocks.len() as u64;
        self.part(Kind::Sessions(sessions))
    }

    /// The last part.
    pub fn trailer(&mut self) -> v1::SnapshotPart {
        self.part(Kind::Trailer(self.trailer))
    }

    fn part(&mut self, kind: Kind) -> v1::SnapshotPart {
        let kind = Some(kind);
        let content = v1::SnapshotContent { kind }.encode_to_vec();
        self.parts += 1;
        self.digest = digest(&self.digest, self.parts, &content);
        v1::SnapshotPart {
            number: self.parts,
            content: content.into(),
            digest: self.digest.to_vec().into(),
        }
    }
}
