//! What reads have in common: which points, what is told of them, and the revision that an answer saw.

use wayfold_index::Filter;
use wayfold_proto::v1;

/// What an answer tells of each point beside its id and distance. The default is nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Include {
    /// Its state, in canonical form.
    pub states: bool,
    /// Its tag.
    pub tags: bool,
    /// The revision that stored its state.
    pub revisions: bool,
    /// Its payload.
    pub payloads: bool,
}

impl Include {
    /// Everything.
    pub fn all() -> Include {
        Include {
            states: true,
            tags: true,
            revisions: true,
            payloads: true,
        }
    }

    pub(crate) fn to_message(self) -> Option<v1::Include> {
        (self != Include::default()).then_some(v1::Include {
            states: self.states,
            tags: self.tags,
            revisions: self.revisions,
            payloads: self.payloads,
        })
    }

    /// The bytes of one neighbour in an answer, but for its payload, which cannot be known.
    pub(crate) fn neighbor_bytes(self, coordinates: usize) -> usize {
        const ID_AND_DISTANCE: usize = 16;
        const LONGEST_VARINT: usize = 10;
        let mut bytes = ID_AND_DISTANCE;
        bytes += if self.states { 8 * coordinates } else { 0 };
        bytes += if self.tags { 8 } else { 0 };
        bytes + if self.revisions { LONGEST_VARINT } else { 0 }
    }
}

pub(crate) fn filter_message(filter: Filter) -> Option<v1::Filter> {
    (filter != Filter::default()).then_some(v1::Filter {
        tag_mask: filter.tag_mask,
        tag_value: filter.tag_value,
        since_revision: filter.since_revision,
    })
}

/// The revisions that the rows of an answer saw: one, unless the read was divided among several calls.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Revisions {
    /// The end of each run of rows that saw one revision, and the revision.
    parts: Vec<(usize, u64)>,
}

impl Revisions {
    pub(crate) fn one(rows: usize, revision: u64) -> Revisions {
        Revisions {
            parts: vec![(rows, revision)],
        }
    }

    /// Puts the parts of another answer behind these.
    pub(crate) fn append(&mut self, other: Revisions) {
        let rows = self.parts.last().map_or(0, |(end, _)| *end);
        for (end, revision) in other.parts {
            match self.parts.last_mut() {
                Some(last) if last.1 == revision => last.0 = rows + end,
                _ => self.parts.push((rows + end, revision)),
            }
        }
    }

    pub(crate) fn oldest(&self) -> u64 {
        self.parts
            .iter()
            .map(|(_, revision)| *revision)
            .min()
            .unwrap_or(0)
    }

    pub(crate) fn of_row(&self, row: usize) -> u64 {
        let part = self.parts.partition_point(|(end, _)| *end <= row);
        self.parts.get(part).map_or(0, |(_, revision)| *revision)
    }
}
