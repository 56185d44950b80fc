//! Pending writes in the columns in which they travel.

use bytes::Bytes;
use wayfold_proto::v1::{self, StepKind};

use super::meanwhile::OpenSearch;

/// One write.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Step<'a> {
    Put {
        tag: u64,
        row: &'a [f64],
        payload: &'a [u8],
    },
    /// Gives a stored point another state; its tag stays.
    Replace {
        row: &'a [f64],
    },
    Remove,
    SetTag(u64),
    SetPayload(&'a [u8]),
}

impl<'a> Step<'a> {
    /// The payload that the point has after the step; None if the step leaves it as it is.
    pub(super) fn payload(&self) -> Option<&'a [u8]> {
        match *self {
            Step::Put { payload, .. } | Step::SetPayload(payload) => Some(payload),
            Step::Replace { .. } => Some(&[]),
            Step::Remove | Step::SetTag(_) => None,
        }
    }
}

/// A write that was not sent, or that the server refused.
#[derive(Clone, Debug, PartialEq)]
pub enum UnsentWrite {
    /// A point was stored.
    Put {
        /// Its id.
        id: u64,
        /// Its tag.
        tag: u64,
        /// Its state, in canonical form.
        state: Vec<f64>,
        /// Its payload; empty for none.
        payload: Vec<u8>,
    },
    /// A point got another state.
    Replace {
        /// Its id.
        id: u64,
        /// Its state, in canonical form.
        state: Vec<f64>,
    },
    /// A point was removed.
    Remove {
        /// Its id.
        id: u64,
    },
    /// A point got a tag.
    SetTag {
        /// Its id.
        id: u64,
        /// The tag.
        tag: u64,
    },
    /// A point got a payload.
    SetPayload {
        /// Its id.
        id: u64,
        /// The payload; empty for none.
        payload: Vec<u8>,
    },
}

/// Consecutive writes, which the server takes as one mutation.
#[derive(Debug, Default)]
pub(super) struct Batch {
    /// Its number in the session, from 1, once it was sent: then it grows no more.
    pub(super) number: u64,
    kinds: Vec<i32>,
    ids: Vec<u64>,
    tags: Vec<u64>,
    coordinates: Vec<f64>,
    /// One a row and one a step that sets one, in their order; none while all are empty.
    payloads: Vec<Bytes>,
    /// The number of rows and of steps that set a payload.
    payload_count: usize,
    rows: usize,
    /// The number of steps that set a tag or a payload.
    pub(super) update_count: usize,
    bytes: usize,
    /// About as many bytes as its searches hold, and its changes of points that others may change too.
    pub(super) kept_bytes: usize,
    /// The revision that it made, once the server has acknowledged it.
    pub(super) revision: Option<u64>,
    /// The first and the last of its ids that the index assigned.
    assigned: Option<(u64, u64)>,
    /// The ids that the caller chose for its puts.
    pub(super) chosen_ids: Vec<u64>,
    /// The searches of its inserts.
    pub(super) searches: Vec<OpenSearch>,
    /// The session that sent it.
    pub(super) session: u64,
    /// The ids that it reserves: a repeated request is the same.
    pub(super) reserve_count: u64,
}

/// The bytes of a step besides its row and its payload: its kind, id and tag.
const STEP_BYTES: usize = 24;

impl Batch {
    pub(super) fn len(&self) -> usize {
        self.ids.len()
    }

    /// The ids of its steps, in order.
    pub(super) fn ids(&self) -> &[u64] {
        &self.ids
    }

    /// About as many bytes as its request has.
    pub(super) fn bytes(&self) -> usize {
        self.bytes
    }

    /// About as many bytes as this process holds for it.
    pub(super) fn held_bytes(&self) -> usize {
        self.bytes + self.kept_bytes
    }

    /// True if the server reads the stored point of a step of this kind, with its payload.
    pub(super) fn is_update(step: &Step<'_>) -> bool {
        matches!(step, Step::SetTag(_) | Step::SetPayload(_))
    }

    /// The bytes that a step adds.
    pub(super) fn step_bytes(step: &Step<'_>) -> usize {
        match step {
            Step::Put { row, payload, .. } => STEP_BYTES + 8 * row.len() + payload.len(),
            Step::Replace { row } => STEP_BYTES + 8 * row.len(),
            Step::SetPayload(payload) => STEP_BYTES + payload.len(),
            Step::Remove | Step::SetTag(_) => STEP_BYTES,
        }
    }

    pub(super) fn push(&mut self, id: u64, step: &Step<'_>) {
        self.bytes += Batch::step_bytes(step);
        self.update_count += usize::from(Batch::is_update(step));
        self.ids.push(id);
        let (kind, tag) = match *step {
            Step::Put { tag, row, payload } => {
                self.push_row(row, payload);
                (StepKind::Put, tag)
            }
            Step::Replace { row } => {
                self.push_row(row, &[]);
                (StepKind::Replace, 0)
            }
            Step::Remove => (StepKind::Remove, 0),
            Step::SetTag(tag) => (StepKind::SetTag, tag),
            Step::SetPayload(payload) => {
                self.push_payload(payload);
                (StepKind::SetPayload, 0)
            }
        };
        self.kinds.push(kind.into());
        self.tags.push(tag);
    }

    /// Notes that the index assigned the id of the last step.
    pub(super) fn assign(&mut self, id: u64) {
        let (first, last) = self.assigned.unwrap_or((id, id));
        self.assigned = Some((first.min(id), last.max(id)));
    }

    /// True if the index assigned this id in the batch.
    pub(super) fn has_assigned(&self, id: u64) -> bool {
        self.may_have_assigned(id) && self.put_ids().any(|put| put == id)
    }

    /// The ids that the index assigned in the batch.
    pub(super) fn assigned_ids(&self) -> impl Iterator<Item = u64> {
        self.put_ids().filter(move |id| self.may_have_assigned(*id))
    }

    /// True if the id is in the range of those that the index assigned in the batch. They may come from two blocks: between
    /// these are ids of others and of the caller.
    pub(super) fn may_have_assigned(&self, id: u64) -> bool {
        let is_near = |(first, last): (u64, u64)| (first..=last).contains(&id);
        self.assigned.is_some_and(is_near) && !self.chosen_ids.contains(&id)
    }

    /// The ids of its puts.
    fn put_ids(&self) -> impl Iterator<Item = u64> {
        let steps = self.ids.iter().zip(&self.kinds);
        let puts = steps.filter(|(_, kind)| **kind == StepKind::Put as i32);
        puts.map(|(id, _)| *id)
    }

    fn push_row(&mut self, row: &[f64], payload: &[u8]) {
        self.push_payload(payload);
        self.rows += 1;
        self.coordinates.extend_from_slice(row);
    }

    fn push_payload(&mut self, payload: &[u8]) {
        if !payload.is_empty() || !self.payloads.is_empty() {
            self.payloads.resize(self.payload_count, Bytes::new());
            self.payloads.push(Bytes::copy_from_slice(payload));
        }
        self.payload_count += 1;
    }

    /// The steps with their ids, in order, for rows of `width` numbers.
    pub(super) fn steps(&self, width: usize) -> impl Iterator<Item = (u64, Step<'_>)> {
        let mut rows = self.coordinates.chunks_exact(width);
        let mut payloads = self.payloads.iter();
        let mut payload = move || payloads.next().map_or(&[][..], |payload| payload);
        (0..self.len()).map(move |position| {
            let tag = self.tags[position];
            let step = match StepKind::try_from(self.kinds[position]) {
                Ok(StepKind::Put) => Step::Put {
                    tag,
                    row: rows.next().unwrap_or_default(),
                    payload: payload(),
                },
                Ok(StepKind::Replace) => {
                    payload();
                    Step::Replace {
                        row: rows.next().unwrap_or_default(),
                    }
                }
                Ok(StepKind::SetTag) => Step::SetTag(tag),
                Ok(StepKind::SetPayload) => Step::SetPayload(payload()),
                _ => Step::Remove,
            };
            (self.ids[position], step)
        })
    }

    /// The writes, for the caller.
    pub(super) fn unsent(&self, width: usize) -> impl Iterator<Item = UnsentWrite> {
        self.steps(width).map(|(id, step)| match step {
            Step::Put { tag, row, payload } => UnsentWrite::Put {
                id,
                tag,
                state: row.to_vec(),
                payload: payload.to_vec(),
            },
            Step::Replace { row } => UnsentWrite::Replace {
                id,
                state: row.to_vec(),
            },
            Step::Remove => UnsentWrite::Remove { id },
            Step::SetTag(tag) => UnsentWrite::SetTag { id, tag },
            Step::SetPayload(payload) => UnsentWrite::SetPayload {
                id,
                payload: payload.to_vec(),
            },
        })
    }

    /// The request, without the names of the index.
    pub(super) fn message(&self) -> v1::WriteRequest {
        let has_tags = self.tags.iter().any(|&tag| tag != 0);
        v1::WriteRequest {
            session: self.session,
            batch: self.number,
            reserve_count: self.reserve_count,
            kinds: self.kinds.clone(),
            ids: self.ids.clone(),
            tags: if has_tags {
                self.tags.clone()
            } else {
                Vec::new()
            },
            states: (self.rows > 0).then(|| v1::States {
                // Batches are limited long before.
                row_count: u32::try_from(self.rows).unwrap_or(u32::MAX),
                coordinates: self.coordinates.clone(),
            }),
            payloads: self.payloads.clone(),
            ..v1::WriteRequest::default()
        }
    }
}
