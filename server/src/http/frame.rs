//! Frames of columns.

use serde_json::{Value, json};
use wayfold_proto::v1;
use xxhash_rust::xxh3::xxh3_64;

/// The most edges of a point. A payload with more is no list of ids of a roadmap, and would fill the picture alone.
const MAX_EDGES: usize = 1024;

/// The part of the points that is sent: those whose hashed id is at most this part of the greatest hash. So a point that comes
/// later is in the sample or not by the same rule, and its removal too.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Share(f64);

impl Share {
    pub(super) const ALL: Self = Self(1.0);

    pub(super) fn from_fraction(fraction: f64) -> Option<Self> {
        (0.0..=1.0).contains(&fraction).then_some(Self(fraction))
    }

    /// The share of `count` points of which about `max` are sent.
    pub(super) fn of(max: u64, count: u64) -> Self {
        match max < count {
            true => Self(max as f64 / count as f64),
            false => Self::ALL,
        }
    }

    pub(super) fn fraction(self) -> f64 {
        self.0
    }

    fn has(self, id: u64) -> bool {
        self == Self::ALL || xxh3_64(&id.to_le_bytes()) <= (self.0 * u64::MAX as f64) as u64
    }
}

/// Frames, one after the other.
#[derive(Debug, Default)]
pub(super) struct Frames(Vec<u8>);

impl Frames {
    pub(super) fn len(&self) -> usize {
        self.0.len()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    pub(super) fn finish(self) -> Vec<u8> {
        self.0
    }

    /// Adds a frame. Heads and bodies are far below 4 GiB: an answer of the service is.
    pub(super) fn push(&mut self, head: &Value, body: &[u8]) {
        let mut head = head.to_string().into_bytes();
        head.resize(head.len().next_multiple_of(8), b' ');
        let padded = body.len().next_multiple_of(8);
        self.0.extend((head.len() as u32).to_le_bytes());
        self.0.extend((padded as u32).to_le_bytes());
        self.0.extend(head);
        self.0.extend(body);
        self.0.resize(self.0.len() + padded - body.len(), 0);
    }

    /// Adds the points of the share.
    pub(super) fn push_points(&mut self, points: &v1::Points, share: Share) {
        let rows: Vec<usize> = (0..points.ids.len())
            .filter(|row| share.has(points.ids[*row]))
            .collect();
        if rows.is_empty() {
            return;
        }
        let coordinates = points.states.as_ref().map_or(&[][..], |it| &it.coordinates);
        let width = coordinates.len() / points.ids.len();
        let mut body = Vec::with_capacity(rows.len() * (24 + 4 * width));
        for column in [&points.ids, &points.revisions, &points.tags] {
            let numbers = rows.iter().map(|row| column.get(*row).copied());
            body.extend(numbers.flat_map(|number| number.unwrap_or_default().to_le_bytes()));
        }
        for row in &rows {
            let row = &coordinates[row * width..(row + 1) * width];
            body.extend(row.iter().flat_map(|it| (*it as f32).to_le_bytes()));
        }
        self.push(&json!({ "kind": "points", "row_count": rows.len() }), &body);
    }

    /// Adds the edges of the points of the share: a payload has `edge_bytes` an edge, and the id at its other end first. A payload
    /// of another length, or with more than [`MAX_EDGES`], has no edges.
    pub(super) fn push_edges(&mut self, points: &v1::Points, share: Share, edge_bytes: usize) {
        let (mut from, mut to) = (Vec::new(), Vec::new());
        for (id, payload) in points.ids.iter().zip(&points.payloads) {
            let is_whole = payload.len().is_multiple_of(edge_bytes);
            if !is_whole || payload.len() / edge_bytes > MAX_EDGES || !share.has(*id) {
                continue;
            }
            for edge in payload.chunks_exact(edge_bytes) {
                from.extend(id.to_le_bytes());
                to.extend(&edge[..8]);
            }
        }
        if !from.is_empty() {
            let head = json!({ "kind": "edges", "row_count": from.len() / 8 });
            from.append(&mut to);
            self.push(&head, &from);
        }
    }

    /// Adds the removed ids of the share.
    pub(super) fn push_removed(&mut self, ids: &[u64], revision: &v1::Revision, share: Share) {
        self.push_ids("removed", ids, revision, share);
    }

    /// Adds the ids of the share whose points `revision` replaces: their new states follow.
    pub(super) fn push_replaced(&mut self, ids: &[u64], revision: &v1::Revision, share: Share) {
        self.push_ids("replaced", ids, revision, share);
    }

    /// Says that everything up to `revision` has been sent.
    pub(super) fn push_at(&mut self, revision: &v1::Revision) {
        self.push(&json!({ "kind": "at", "revision": json_of(revision) }), &[]);
    }

    fn push_ids(&mut self, kind: &str, ids: &[u64], revision: &v1::Revision, share: Share) {
        let ids: Vec<u64> = ids.iter().copied().filter(|id| share.has(*id)).collect();
        if ids.is_empty() {
            return;
        }
        let body: Vec<u8> = ids.iter().flat_map(|id| id.to_le_bytes()).collect();
        let head = json!({ "kind": kind, "row_count": ids.len(), "revision": json_of(revision) });
        self.push(&head, &body);
    }
}

/// A revision as the verbs write it.
pub(super) fn json_of(revision: &v1::Revision) -> Value {
    json!({ "uid": revision.uid, "number": revision.number })
}
