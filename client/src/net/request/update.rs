//! Setting tags and payloads of stored points.

use std::ops::Range;

use bytes::Bytes;
use wayfold_proto::v1;

use super::{
    ID_AND_TAG_BYTES, awaitable, check_column, fresh_operation_id, mutation, payload_bytes,
};
use crate::{Error, IndexHandle, Revision, net::limits::Division};

/// Sets tags or payloads of stored points, whose states stay; await it to send it.
///
/// Divided among several calls like an [`Insert`](crate::Insert).
#[derive(Clone, Debug)]
#[must_use = "a request does nothing until it is awaited"]
pub struct Update {
    index: IndexHandle,
    ids: Vec<u64>,
    tags: Vec<u64>,
    tag_mask: Option<u64>,
    payloads: Vec<Bytes>,
    if_revision: Option<Revision>,
    operation_id: String,
}

/// The effect of an update.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Updated {
    /// The number of points that changed.
    pub updated_count: u64,
    /// The number of points that already were as the update sets them.
    pub unchanged_count: u64,
    /// The revision that the update, or the last of its parts, made or found.
    pub revision: Revision,
}

awaitable!(Update => Updated);
mutation!(Update);

const CALL: &str = "update";

impl Update {
    pub(crate) fn new(index: IndexHandle, ids: Vec<u64>) -> Update {
        Update {
            index,
            ids,
            tags: Vec::new(),
            tag_mask: None,
            payloads: Vec::new(),
            if_revision: None,
            operation_id: fresh_operation_id(),
        }
    }

    /// The new tags: one an id, or one for all.
    pub fn tags(mut self, tags: impl Into<Vec<u64>>) -> Update {
        self.tags = tags.into();
        self
    }

    /// Sets only these bits of the tags; all of them without it.
    pub fn tag_mask(mut self, mask: u64) -> Update {
        self.tag_mask = Some(mask);
        self
    }

    /// The new payloads, one an id, of at most 64 KiB.
    pub fn payloads<P: Into<Bytes>>(mut self, payloads: impl IntoIterator<Item = P>) -> Update {
        self.payloads = payloads.into_iter().map(Into::into).collect();
        self
    }

    /// Compare and set: fails with `FAILED_PRECONDITION`, naming the ids, if one of the points changed after this
    /// revision.
    pub fn if_revision(mut self, revision: Revision) -> Update {
        self.if_revision = Some(revision);
        self
    }

    async fn send(self) -> Result<Updated, Error> {
        let rows = self.ids.len();
        check_column("tags", self.tags.len(), &[0, 1, rows], "ids")?;
        check_column("payloads", self.payloads.len(), &[0, rows], "ids")?;
        let mut updated = Updated {
            updated_count: 0,
            unchanged_count: 0,
            revision: self.index.revision(),
        };
        let division = Division::new(&self.index, rows, &self.ids, &self.operation_id);
        let written = division.write(
            |limits| limits.max_ids_per_call,
            |row| self.row_bytes(row),
            |part, operation_id| self.message(part, operation_id),
            |answer, _| {
                updated.updated_count += answer.updated_count;
                updated.unchanged_count += answer.unchanged_count;
                updated.revision = self.index.answered(CALL, answer.revision)?;
                Ok(())
            },
        );
        written.await?;
        Ok(updated)
    }

    fn row_bytes(&self, row: usize) -> usize {
        ID_AND_TAG_BYTES + payload_bytes(&self.payloads, row)
    }

    fn message(&self, part: &Range<usize>, operation_id: &str) -> v1::UpdateRequest {
        let tags = match self.tags.len() {
            0 | 1 => &self.tags,
            _ => &self.tags[part.clone()],
        };
        v1::UpdateRequest {
            index_name: self.index.name().to_owned(),
            ids: self.ids[part.clone()].to_vec(),
            tags: tags.to_vec(),
            tag_mask: self.tag_mask,
            payloads: self.payloads.get(part.clone()).unwrap_or_default().to_vec(),
            if_revision: self.if_revision.as_ref().map(Revision::to_message),
            operation_id: operation_id.to_owned(),
            uid: self.index.uid().to_owned(),
        }
    }
}
