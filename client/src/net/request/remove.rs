//! Removing points.

use wayfold_proto::v1;

use super::{awaitable, fresh_operation_id, mutation};
use crate::{Error, IndexHandle, Revision, net::limits::Division};

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
    /// The number of points removed.
    pub removed_count: u64,
    /// The number of ids that were not stored.
    pub missing_count: u64,
    /// The revision that the removal, or the last of its parts, made or found.
    pub revision: Revision,
}

awaitable!(Remove => Removed);
mutation!(Remove);

const CALL: &str = "remove";

impl Remove {
    pub(crate) fn new(index: IndexHandle, ids: Vec<u64>) -> Remove {
        Remove {
            index,
            ids,
            operation_id: fresh_operation_id(),
        }
    }

    async fn send(self) -> Result<Removed, Error> {
        const ID_BYTES: usize = 8;
        let rows = self.ids.len();
        let mut removed = Removed {
            removed_count: 0,
            missing_count: 0,
            revision: self.index.revision(),
        };
        let division = Division::new(&self.index, rows, &self.ids, &self.operation_id);
        let written = division.write(
            |limits| limits.max_ids_per_call,
            |_| ID_BYTES,
            |part, operation_id| v1::RemoveRequest {
                index_name: self.index.name().to_owned(),
                ids: self.ids[part.clone()].to_vec(),
                operation_id: operation_id.to_owned(),
                uid: self.index.uid().to_owned(),
            },
            |answer, _| {
                removed.removed_count += answer.removed_count;
                removed.missing_count += answer.missing_count;
                removed.revision = self.index.answered(CALL, answer.revision)?;
                Ok(())
            },
        );
        written.await?;
        Ok(removed)
    }
}
