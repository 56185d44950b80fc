//! The stored payloads that an insert needs: those that its rows are compared with, and those of the neighbours that it
//! answers. They are read before the insert has the writer.

use bytes::Bytes;
use sha2::{Digest as _, Sha256};

use super::{
    Call, Error,
    answer::payload_bytes,
    stored::{BATCH, ReadAhead},
};
use crate::{
    log::Digest,
    registry::{Hosted, Published, Writer},
};

const DOING: &str = "while reading payloads; nothing was changed";

/// See the module.
pub(super) struct Payloads {
    /// Payloads that rows are compared with: their digests, as all of them together may be large.
    compared: ReadAhead<Digest>,
    /// Payloads of neighbours; None if they are not told.
    neighbors: Option<ReadAhead<Bytes>>,
}

/// Ids of points whose payloads have to be read.
#[derive(Default)]
pub(super) struct Unread {
    /// To compare them.
    pub(super) compared: Vec<u64>,
    /// To tell them.
    pub(super) neighbors: Vec<u64>,
}

impl Unread {
    pub(super) fn is_empty(&self) -> bool {
        self.compared.is_empty() && self.neighbors.is_empty()
    }
}

impl Payloads {
    /// Nothing is read yet.
    pub(super) fn new(answers: bool) -> Self {
        let neighbors = || ReadAhead::new(true, |point| point.payload.clone());
        Self {
            compared: ReadAhead::new(false, |point| Sha256::digest(&point.payload).into()),
            neighbors: answers.then(neighbors),
        }
    }

    /// Whether `payload` is stored under an id; None if that has to be read.
    pub(super) fn is_stored(&self, id: u64, payload: &[u8]) -> Option<bool> {
        let stored = self.compared.get(id)?;
        Some(*stored == Digest::from(Sha256::digest(payload)))
    }

    /// The payload of a neighbour; None if it has to be read.
    pub(super) fn of_neighbor(&self, id: u64) -> Option<&Bytes> {
        self.neighbors.as_ref()?.get(id)
    }

    /// Reads payloads of `head`; of those that are told, until they take more than `most` bytes of an answer. Returns how
    /// many bytes they take.
    pub(super) async fn read(
        &mut self,
        call: &Call,
        hosted: &Hosted,
        head: &Published,
        mut unread: Unread,
        most: usize,
    ) -> Result<usize, Error> {
        let compared = &unread.compared;
        let compared = self.compared.read(call, DOING, hosted, head, compared);
        compared.await?;
        let Some(neighbors) = &mut self.neighbors else {
            return Ok(0);
        };
        neighbors.begin_at(head);
        unread.neighbors.sort_unstable();
        unread.neighbors.dedup();
        let mut bytes = 0;
        for ids in unread.neighbors.chunks(BATCH) {
            if bytes > most {
                break;
            }
            neighbors.read(call, DOING, hosted, head, ids).await?;
            let payloads = ids.iter().filter_map(|id| neighbors.get(*id));
            bytes += payloads.map(payload_bytes).sum::<usize>();
        }
        Ok(bytes)
    }

    /// Brings what was read up to the writer's head, or forgets it.
    pub(super) fn catch_up(&mut self, hosted: &Hosted, writer: &Writer) {
        self.compared.catch_up(hosted, writer);
        if let Some(neighbors) = &mut self.neighbors {
            neighbors.catch_up(hosted, writer);
        }
    }
}
