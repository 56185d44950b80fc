//! The index that a copy follows.

use std::sync::Arc;

use wayfold_index::Space;

use crate::{IndexInfo, Revision};

/// An index of a server, of one uid.
#[derive(Debug)]
pub(crate) struct ServedIndex {
    name: String,
    uid: Arc<str>,
    space: Space,
}

impl ServedIndex {
    pub(crate) fn new(name: &str, uid: Arc<str>, space: Space) -> ServedIndex {
        ServedIndex {
            name: name.to_owned(),
            uid,
            space,
        }
    }

    pub(super) fn of(info: IndexInfo) -> ServedIndex {
        ServedIndex::new(&info.name, info.revision.uid, info.space)
    }

    pub(super) fn name(&self) -> &str {
        &self.name
    }

    pub(super) fn uid(&self) -> &Arc<str> {
        &self.uid
    }

    pub(super) fn space(&self) -> &Space {
        &self.space
    }

    /// The number of coordinates of a state.
    pub(super) fn coordinates(&self) -> usize {
        self.space.coordinates()
    }

    /// Revision `number` of its uid.
    pub(super) fn revision_at(&self, number: u64) -> Revision {
        Revision::new(Arc::clone(&self.uid), number)
    }
}
