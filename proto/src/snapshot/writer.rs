//! Parts from what is in them.

use prost::Message;

use super::{Digest, FORMAT_VERSION, Header, digest};
use crate::{
    space,
    v1::{self, snapshot_content::Content},
};

/// Makes the parts of one snapshot, in order.
///
/// The caller is responsible for their contents. A [`Reader`](super::Reader) checks them.
#[derive(Clone, Debug, Default)]
pub struct Writer {
    parts: u64,
    points: u64,
    digest: Digest,
}

impl Writer {
    /// Begins a snapshot.
    pub fn new() -> Writer {
        Writer::default()
    }

    /// The first part.
    pub fn header(&mut self, header: &Header) -> v1::SnapshotPart {
        self.part(Content::Header(v1::SnapshotHeader {
            format_version: FORMAT_VERSION,
            name: header.name.clone(),
            uid: header.uid.clone(),
            space: Some(space::to_message(&header.space)),
            space_text: header.space.to_string(),
            revision: header.revision,
            next_id: header.next_id,
            points: header.points,
        }))
    }

    /// A part of points, with ids above all before.
    pub fn points(&mut self, points: v1::SnapshotPoints) -> v1::SnapshotPart {
        self.points += points
            .points
            .as_ref()
            .map_or(0, |points| points.ids.len() as u64);
        self.part(Content::Points(points))
    }

    /// How many points there were.
    pub fn points_written(&self) -> u64 {
        self.points
    }

    /// The last part.
    pub fn trailer(&mut self) -> v1::SnapshotPart {
        let points = self.points;
        self.part(Content::Trailer(v1::SnapshotTrailer { points }))
    }

    fn part(&mut self, content: Content) -> v1::SnapshotPart {
        let content = Some(content);
        let content = v1::SnapshotContent { content }.encode_to_vec();
        self.parts += 1;
        self.digest = digest(&self.digest, self.parts, &content);
        v1::SnapshotPart {
            number: self.parts,
            content: content.into(),
            digest: self.digest.to_vec().into(),
        }
    }
}
