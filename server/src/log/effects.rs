//! The effects of one mutation.

use std::sync::Arc;

use bytes::Bytes;
use wayfold_index::{PointRef, Points};

use super::{
    Digest,
    cursor::Cursor,
    record::{push_operation, read_operation},
    session::Batch,
};

/// The outcome of a row that a mutation stored. Rows that changed nothing leave no effect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// A new point.
    Inserted,
    /// A new state, tag or payload under an id that held another point.
    Replaced,
    /// A new tag or payload; the state is unchanged.
    Updated,
}

/// A call that takes effect once: the id and digest that recognise its retry, and the response to a retry.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Operation {
    /// The id that the caller gave it.
    pub id: String,
    /// The digest of the request.
    pub fingerprint: Digest,
    /// The response, encoded.
    pub response: Bytes,
}

impl Operation {
    /// The approximate number of bytes that remembering it takes.
    pub fn bytes(&self) -> usize {
        self.id.len() + self.response.len() + 128
    }

    /// Its stored form without a checksum, the same bytes as in a record.
    pub(super) fn encode(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        push_operation(&mut bytes, self);
        bytes
    }

    /// Decodes a stored form; None if the bytes have another form.
    pub(super) fn decode(bytes: &[u8]) -> Option<Self> {
        let mut cursor = Cursor::new(bytes);
        let operation = read_operation(&mut cursor)?;
        cursor.is_empty().then_some(operation)
    }
}

/// The complete effects of one mutation. Applying them needs no decision.
#[derive(Clone, Debug, PartialEq)]
pub struct Effects {
    pub(super) stored: Points,
    pub(super) outcomes: Vec<Outcome>,
    /// One payload for each point of `stored`, or no payload if all are empty.
    pub(super) payloads: Vec<Bytes>,
    pub(super) removed: Vec<u64>,
    pub(super) operation: Option<Arc<Operation>>,
    pub(super) batch: Option<Arc<Batch>>,
}

impl Effects {
    /// Empty effects, for rows of `coordinates` numbers.
    pub fn new(coordinates: usize) -> Self {
        Self {
            stored: Points::new(coordinates),
            outcomes: Vec::new(),
            payloads: Vec::new(),
            removed: Vec::new(),
            operation: None,
            batch: None,
        }
    }

    /// Stores a point and replaces one with the same id. `payload` is kept without a copy, so it must not be a slice of
    /// a larger buffer: that buffer would stay in memory.
    pub fn store(&mut self, point: PointRef<'_>, outcome: Outcome, payload: Bytes) {
        if self.payloads.is_empty() && !payload.is_empty() {
            self.payloads.resize(self.stored.len(), Bytes::new());
        }
        if !self.payloads.is_empty() || !payload.is_empty() {
            self.payloads.push(payload);
        }
        self.stored.push_point(point);
        self.outcomes.push(outcome);
    }

    /// Removes a stored point.
    pub fn remove(&mut self, id: u64) {
        self.removed.push(id);
    }

    /// Sets the operation that caused the mutation.
    pub fn set_operation(&mut self, operation: Option<Arc<Operation>>) {
        self.operation = operation;
    }

    /// Sets the session's batch that is this mutation.
    pub fn set_batch(&mut self, batch: Option<Arc<Batch>>) {
        self.batch = batch;
    }

    /// True if nothing changed, and no session has to remember it; the operation does not count.
    pub fn is_empty(&self) -> bool {
        self.stored.is_empty() && self.removed.is_empty() && self.batch.is_none()
    }

    /// True if it only stores new points.
    pub fn only_adds(&self) -> bool {
        let mut outcomes = self.outcomes.iter();
        self.removed.is_empty() && outcomes.all(|&outcome| outcome == Outcome::Inserted)
    }

    /// The number of new points it stores.
    pub fn inserted(&self) -> usize {
        let outcomes = self.outcomes.iter();
        outcomes
            .filter(|&&outcome| outcome == Outcome::Inserted)
            .count()
    }

    /// The number of points it stores or removes.
    pub fn len(&self) -> usize {
        self.stored.len() + self.removed.len()
    }

    /// The points it stores, each id once. A point is complete even if only its tag or payload is new.
    pub fn stored(&self) -> &Points {
        &self.stored
    }

    /// The outcomes of the points it stores, in the same order.
    pub fn outcomes(&self) -> &[Outcome] {
        &self.outcomes
    }

    /// The payload of the stored point in `slot`.
    pub fn payload(&self, slot: usize) -> Bytes {
        self.payloads.get(slot).cloned().unwrap_or_default()
    }

    /// True if a stored point has a payload.
    pub fn has_payloads(&self) -> bool {
        !self.payloads.is_empty()
    }

    /// The ids of the points it removes. All of them were stored before, and none of them is in `stored`.
    pub fn removed(&self) -> &[u64] {
        &self.removed
    }

    /// The operation that caused it.
    pub fn operation(&self) -> Option<&Arc<Operation>> {
        self.operation.as_ref()
    }

    /// The session's batch that it is.
    pub fn batch(&self) -> Option<&Arc<Batch>> {
        self.batch.as_ref()
    }

    /// The least id above the ids that it stores or reserves; 0 if there are none.
    pub fn next_id(&self) -> u64 {
        let highest = self.stored.ids().iter().max();
        let reserved = self.batch.as_ref().map_or(0, |batch| batch.reserved.end);
        highest.map_or(0, |id| id + 1).max(reserved)
    }

    /// True if it ends writer sessions. A session may have a million blocks of ids.
    pub fn ends_sessions(&self) -> bool {
        self.batch().is_some_and(|batch| !batch.ended.is_empty())
    }

    /// Its approximate size in bytes.
    pub fn bytes(&self) -> usize {
        let row = 8 * self.stored.coordinates() + 3 * 8 + 1;
        let payloads: usize = self.payloads.iter().map(|payload| payload.len() + 32).sum();
        let operation = self
            .operation
            .as_ref()
            .map_or(0, |operation| operation.bytes());
        let batch = self.batch.as_ref().map_or(0, |batch| batch.bytes());
        self.stored.len() * row + payloads + 8 * self.removed.len() + operation + batch + 256
    }
}
