//! The description of an index.

use std::sync::Arc;

use wayfold_index::Space;
use wayfold_proto::{
    space,
    v1::{self, PayloadEncoding},
};

use crate::{Error, Refusal, Revision};

/// The indices of a server.
#[derive(Clone, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct IndexList {
    /// Those that are not damaged, by name.
    pub indexes: Vec<IndexInfo>,
    /// The damaged ones, by name.
    pub damaged: Vec<DamagedIndex>,
}

/// An index that cannot be read, or cannot be written. Its name is taken until it is deleted.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct DamagedIndex {
    /// Its name.
    pub name: String,
    /// Its uid.
    pub uid: String,
    /// The refusal of every call for it except its deletion; if only its journal is damaged, of mutations and of reads
    /// with `latest`.
    pub error: Refusal,
}

impl DamagedIndex {
    pub(crate) fn from_message(damaged: v1::DamagedIndex) -> DamagedIndex {
        DamagedIndex {
            name: damaged.name,
            uid: damaged.uid,
            error: Refusal::from_message(&damaged.error.unwrap_or_default()),
        }
    }
}

/// An index as it stood at one revision.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct IndexInfo {
    /// Its name.
    pub name: String,
    /// The space of its states.
    pub space: Space,
    /// The revision described here.
    pub revision: Revision,
    /// The number of its points.
    pub point_count: u64,
    /// The number of coordinates of a state (SE(3): 7).
    pub coordinate_count: usize,
    /// The dimension of the manifold (SE(3): 6).
    pub dimension: usize,
    /// An estimate of the memory its search structure holds, in bytes.
    pub memory_bytes: u64,
    /// How its payloads hold edges.
    pub payload_encoding: PayloadEncoding,
}

impl IndexInfo {
    pub(crate) fn uid(&self) -> &Arc<str> {
        &self.revision.uid
    }

    /// Revision `number` of its uid.
    pub(crate) fn revision_at(&self, number: u64) -> Revision {
        Revision::new(Arc::clone(self.uid()), number)
    }

    pub(crate) fn from_message(
        call: &'static str,
        index: Option<v1::Index>,
    ) -> Result<IndexInfo, Error> {
        let index = index.ok_or_else(|| Error::protocol(call, "it describes no index"))?;
        let payload_encoding = index.payload_encoding();
        let message = index.space.unwrap_or_default();
        let space = space::from_message(&message)
            .map_err(|error| Error::protocol(call, error.to_string()))?;
        Ok(IndexInfo {
            name: index.name,
            revision: Revision::from_message(call, index.revision, &"".into())?,
            point_count: index.point_count,
            coordinate_count: space.coordinates(),
            dimension: space.dimension(),
            memory_bytes: index.memory_bytes,
            payload_encoding,
            space,
        })
    }
}
