//! Reading points by id.

use std::ops::Range;

use wayfold_proto::v1;

use super::awaitable;
use crate::{
    Error, Include, IndexHandle, Points,
    net::limits::{self, READ_ROWS},
};

/// Reads points by id, each id once; await it to send it. Ids that are not stored are `NOT_FOUND`, by name.
///
/// More than [`READ_ROWS`](crate::READ_ROWS) ids, or more points than an answer holds, are divided among several calls.
#[derive(Clone, Debug)]
#[must_use = "a request does nothing until it is awaited"]
pub struct Get {
    index: IndexHandle,
    ids: Vec<u64>,
    include: Include,
}

awaitable!(Get => Points);

impl Get {
    pub(crate) fn new(index: IndexHandle, ids: Vec<u64>) -> Get {
        Get {
            index,
            ids,
            include: Include::points(),
        }
    }

    /// The columns of the answer in addition to ids; states, tags and revisions unless set.
    pub fn include(mut self, include: Include) -> Get {
        self.include = include;
        self
    }

    async fn send(self) -> Result<Points, Error> {
        const CALL: &str = "get";
        let (limits, mut deadline) = self.index.limits(CALL, self.ids.len()).await?;
        let max_rows = limits.max_ids_per_call.min(READ_ROWS);
        if self.ids.len() > max_rows {
            limits::check_unique(&self.ids)?;
        }
        let this = &self;
        let read = |part: Range<usize>| {
            let deadline = deadline.take();
            async move {
                let message = || v1::GetRequest {
                    index_name: this.index.name().to_owned(),
                    ids: this.ids[part.clone()].to_vec(),
                    include: this.include.to_message(),
                    min_revision: this.index.min_revision(),
                    latest: this.index.reads_latest(),
                };
                let answer = this
                    .index
                    .call(CALL, deadline, message, |mut stub, request| async move {
                        stub.get(request).await
                    })
                    .await?;
                let revision = this.index.answered(CALL, answer.revision)?;
                let width = this.index.coordinates();
                let points =
                    Points::from_message(CALL, answer.points, revision, width, this.include)?;
                match points.ids() == &this.ids[part.clone()] {
                    true => Ok(points),
                    false => Err(Error::Protocol {
                        call: CALL,
                        problem: "the points have other ids than the request".to_owned(),
                    }),
                }
            }
        };
        limits::read_in_parts(self.ids.len(), max_rows, read, Points::append).await
    }
}
