//! The columns of an answer.

use wayfold_proto::v1;

/// The columns of an answer in addition to ids and, in a search, distances. The default is none.
///
/// ```
/// use wayfold::Include;
///
/// let include = Include::none().states().tags();
/// assert!(include.states && include.tags && !include.payloads);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Include {
    /// The points' states, in canonical form.
    pub states: bool,
    /// The points' tags.
    pub tags: bool,
    /// The revisions that stored the points' states.
    pub revisions: bool,
    /// The points' payloads.
    pub payloads: bool,
}

impl Include {
    /// No columns.
    pub const fn none() -> Include {
        Include {
            states: false,
            tags: false,
            revisions: false,
            payloads: false,
        }
    }

    /// All columns.
    pub const fn all() -> Include {
        Include::none().states().tags().revisions().payloads()
    }

    /// Adds the states.
    pub const fn states(mut self) -> Include {
        self.states = true;
        self
    }

    /// Adds the tags.
    pub const fn tags(mut self) -> Include {
        self.tags = true;
        self
    }

    /// Adds the revisions.
    pub const fn revisions(mut self) -> Include {
        self.revisions = true;
        self
    }

    /// Adds the payloads.
    pub const fn payloads(mut self) -> Include {
        self.payloads = true;
        self
    }

    /// The default of reads of points: all but the payloads. Copies of an index need all of these.
    pub(crate) const fn points() -> Include {
        Include::none().states().tags().revisions()
    }

    pub(crate) fn to_message(self) -> Option<v1::Include> {
        Some(v1::Include {
            with_states: self.states,
            with_tags: self.tags,
            with_revisions: self.revisions,
            with_payloads: self.payloads,
        })
    }

    /// The bytes of one neighbour in an answer, without its payload, which cannot be known.
    pub(crate) fn neighbor_bytes(self, coordinates: usize) -> usize {
        const ID_AND_DISTANCE: usize = 16;
        const MAX_VARINT: usize = 10;
        let mut bytes = ID_AND_DISTANCE;
        bytes += if self.states { 8 * coordinates } else { 0 };
        bytes += if self.tags { 8 } else { 0 };
        bytes + if self.revisions { MAX_VARINT } else { 0 }
    }
}
