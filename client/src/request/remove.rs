//! Removing points.

use wayfold_proto::v1;

use super::{awaitable, fresh_operation_id, partial};
use crate::{Error, IndexHandle, Revision, limits};

/// Removes points by id; await it to send it.
///
/// Divided among several calls like an [`Insert`](crate::Insert).
#[derive(Clone, Debug)]
#[must_use = "a request does nothing until it is awaited"]
pub struct Remove {
    index: IndexHandle,
    ids: Vec<u64>,
    operation_id: String,
}

/// The effect of a removal.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Removed {
    /// How many points were removed.
    pub removed_count: u64,
    /// How many were not stored.
    pub missing_count: u64,
    /// The revision that the removal, or the last of its parts, made or found.
    pub revision: Revision,
}

awaitable!(Remove => Removed);

const CALL: &str = "remove";

impl Remove {
    /// The index that it writes to.
    #[cfg(feature = "replica")]
    pub(crate) fn index(&self) -> &IndexHandle {
        &self.index
    }

    pub(crate) fn new(index: IndexHandle, ids: Vec<u64>) -> Remove {
        Remove {
            index,
            ids,
            operation_id: fresh_operation_id(),
        }
    }

    /// Sets the operation id; see [`Insert::operation_id`](crate::Insert::operation_id).
    pub fn operation_id(mut self, id: impl Into<String>) -> Remove {
        self.operation_id = id.into();
        self
    }

    async fn send(self) -> Result<Removed, Error> {
        const ID_BYTES: usize = 8;
        let rows = self.ids.len();
        let limits = self.index.limits(CALL, rows).await?;
        let parts = limits::divide(&limits, rows, limits.ids_per_call, |_| ID_BYTES);
        if parts.len() > 1 {
            limits::check_unique(&self.ids)?;
        }
        let mut removed = Removed {
            removed_count: 0,
            missing_count: 0,
            revision: self.index.revision(),
        };
        let operation_ids = limits::operation_ids(&self.operation_id, &parts)?;
        for (part, operation_id) in parts.iter().zip(&operation_ids) {
            let message = || v1::RemoveRequest {
                index: self.index.name().to_owned(),
                ids: self.ids[part.clone()].to_vec(),
                operation_id: operation_id.clone(),
                uid: self.index.uid().to_owned(),
            };
            let answer = self
                .index
                .call(CALL, message, |mut stub, request| async move {
                    stub.remove(request).await
                })
                .await
                .map_err(|error| partial(part, rows, error))?;
            removed.removed_count += answer.removed_count;
            removed.missing_count += answer.missing_count;
            removed.revision = self.index.answered(CALL, answer.revision)?;
        }
        Ok(removed)
    }
}
