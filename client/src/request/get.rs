//! Reading points by id.

use wayfold_proto::v1;

use super::awaitable;
use crate::{
    Error, IndexHandle, Points,
    limits::{self, READ_ROWS},
};

/// Reads points by id, each id once; await it to send it. Ids that are not stored are `NOT_FOUND`, by name.
///
/// More ids than [`READ_ROWS`](crate::READ_ROWS), or points than an answer holds, are divided among several calls.
#[derive(Clone, Debug)]
#[must_use = "a request does nothing until it is awaited"]
pub struct Get {
    index: IndexHandle,
    ids: Vec<u64>,
    payloads: bool,
}

awaitable!(Get => Points);

impl Get {
    pub(crate) fn new(index: IndexHandle, ids: Vec<u64>) -> Get {
        Get {
            index,
            ids,
            payloads: false,
        }
    }

    /// Reads the payloads too.
    pub fn payloads(mut self) -> Get {
        self.payloads = true;
        self
    }

    async fn send(self) -> Result<Points, Error> {
        const CALL: &str = "get";
        if self.ids.len() > READ_ROWS {
            limits::check_unique(&self.ids)?;
        }
        let this = &self;
        let read = |part: std::ops::Range<usize>| async move {
            let message = || v1::GetRequest {
                index: this.index.name().to_owned(),
                ids: this.ids[part.clone()].to_vec(),
                payloads: this.payloads,
                at: Some(this.index.read_at()),
            };
            let answer = this
                .index
                .call(CALL, message, |mut stub, request| async move {
                    stub.get(request).await
                })
                .await?;
            this.index.told(&answer.uid, answer.revision);
            let points = Points::from_message(
                CALL,
                answer.points,
                answer.revision,
                this.index.coordinates(),
                this.payloads,
            )?;
            match points.ids() == &this.ids[part.clone()] {
                true => Ok(points),
                false => Err(Error::Protocol {
                    call: CALL,
                    problem: "other points than were asked for".to_owned(),
                }),
            }
        };
        limits::read_in_parts(self.ids.len(), READ_ROWS, read, Points::append).await
    }
}
