//! The stored payloads that an insert reads before it holds the writer: those that it compares with its rows, and those
//! of the neighbours in its answer.

use bytes::Bytes;
use sha2::{Digest as _, Sha256};

use super::{Call, Error, answer::payload_bytes, stored::ReadAhead};
use crate::{
    admission::AnswerBytes,
    log::Digest,
    registry::{Hosted, Published, Writer},
};

const DOING: &str = "while reading payloads; nothing was changed";

/// The payloads of neighbours that are read at once: they pass the limit of the answer by a megabyte at most.
const PAYLOADS_READ: usize = 16;

/// The payloads read so far.
pub(super) struct Payloads {
    /// Digests of the payloads to compare with: all payloads together may be large.
    compared: ReadAhead<Digest>,
    /// Payloads of neighbours; None if the answer has none.
    neighbors: Option<ReadAhead<Bytes>>,
    /// The bytes of these: an answer takes them from here.
    held: AnswerBytes,
}

/// Holds the memory of a column of payloads for the call. The bytes of the request do not cover it: an empty payload has two.
pub(super) fn hold_column(call: &Call, payloads: &[Bytes]) -> Result<AnswerBytes, Error> {
    let mut held = call.answer_bytes();
    held.take(size_of_val(payloads))?;
    Ok(held)
}

/// Ids of points whose payloads are still to be read.
#[derive(Default)]
pub(super) struct UnreadPayloads {
    /// For comparison.
    pub(super) compared: Vec<u64>,
    /// For the answer.
    pub(super) neighbors: Vec<u64>,
}

impl UnreadPayloads {
    pub(super) fn is_empty(&self) -> bool {
        self.compared.is_empty() && self.neighbors.is_empty()
    }
}

impl Payloads {
    /// No payloads yet; `answers` is true if the answer has payloads of neighbours.
    pub(super) fn new(call: &Call, answers: bool) -> Self {
        let neighbors = || ReadAhead::new(true, |point| point.payload.clone());
        Self {
            compared: ReadAhead::new(false, |point| Sha256::digest(&point.payload).into()),
            neighbors: answers.then(neighbors),
            held: call.answer_bytes(),
        }
    }

    /// True if `payload` is stored under an id; None if it is not read yet.
    pub(super) fn is_stored(&self, id: u64, payload: &[u8]) -> Option<bool> {
        let stored = self.compared.get(id)?;
        Some(*stored == Digest::from(Sha256::digest(payload)))
    }

    /// The payload of a neighbour; None if it is not read yet.
    pub(super) fn of_neighbor(&self, id: u64) -> Option<&Bytes> {
        self.neighbors.as_ref()?.get(id)
    }

    /// Reads payloads of `published`; those for the answer until they exceed `most` bytes of it.
    pub(super) async fn read(
        &mut self,
        call: &Call,
        hosted: &Hosted,
        published: &Published,
        mut unread: UnreadPayloads,
        most: usize,
    ) -> Result<(), Error> {
        let compared = &unread.compared;
        let compared = self.compared.read(call, DOING, hosted, published, compared);
        compared.await?;
        let Some(neighbors) = &mut self.neighbors else {
            return Ok(());
        };
        neighbors.begin_at(published);
        unread.neighbors.sort_unstable();
        unread.neighbors.dedup();
        let mut bytes = 0;
        for ids in unread.neighbors.chunks(PAYLOADS_READ) {
            if bytes > most {
                break;
            }
            neighbors.read(call, DOING, hosted, published, ids).await?;
            let payloads = ids.iter().filter_map(|id| neighbors.get(*id));
            let read = payloads.map(payload_bytes).sum::<usize>();
            self.held.take(read)?;
            bytes += read;
        }
        Ok(())
    }

    /// Catches up to the writer's newest record, or forgets the payloads.
    pub(super) fn catch_up(&mut self, hosted: &Hosted, writer: &Writer) {
        self.compared.catch_up(hosted, writer);
        if let Some(neighbors) = &mut self.neighbors
            && neighbors.catch_up(hosted, writer).is_none()
        {
            self.held.clear();
        }
    }
}
