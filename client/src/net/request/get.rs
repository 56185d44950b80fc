//! Reading points by id.

use std::ops::Range;

use wayfold_proto::v1;

use super::awaitable;
use crate::{
    Error, Include, IndexHandle, Limits, Points,
    net::{
        call::Call,
        limits::{self, READ_ROWS},
    },
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
        let max_rows = |limits: &Limits| {
            let max_rows = limits.max_ids_per_call.min(READ_ROWS);
            if self.ids.len() > max_rows {
                limits::check_unique(&self.ids)?;
            }
            Ok(max_rows)
        };
        limits::read(
            &self.index,
            self.ids.len(),
            max_rows,
            |part| self.message(part),
            |answer, part| self.points(answer, part),
            Points::append,
        )
        .await
    }

    fn message(&self, part: Range<usize>) -> v1::GetRequest {
        v1::GetRequest {
            index_name: self.index.name().to_owned(),
            ids: self.ids[part].to_vec(),
            include: self.include.to_message(),
            min_revision: self.index.min_revision(),
            latest: self.index.reads_latest(),
        }
    }

    fn points(&self, answer: v1::GetResponse, part: Range<usize>) -> Result<Points, Error> {
        const CALL: &str = v1::GetRequest::NAME;
        let revision = self.index.answered(CALL, answer.revision)?;
        let width = self.index.coordinates();
        let points = Points::from_message(CALL, answer.points, revision, width, self.include)?;
        match points.ids() == &self.ids[part] {
            true => Ok(points),
            false => Err(Error::protocol(
                CALL,
                "the points have other ids than the request",
            )),
        }
    }
}
