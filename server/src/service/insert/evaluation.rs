//! The rows of an insert, evaluated against the newest state of the index.

use bytes::Bytes;
use wayfold_index::{EarlierAnswer, Neighbor, Search};
use wayfold_proto::{END_OF_IDS, v1};

use super::{Insertion, is_same};
use crate::{
    admission::AnswerBytes,
    log::{Effects, Outcome},
    registry::{Hosted, Writer},
    service::{
        Call, Error, Limits,
        answer::{AnswerBudget, NeighborColumns},
        payloads::{Payloads, UnreadPayloads},
        prefetch::{Prefetch, PrefetchedRow},
        staging::Staging,
    },
};

/// An insertion evaluated against the newest state of an index, row by row, invisible to others.
pub(super) struct Evaluation<'a> {
    insertion: &'a Insertion,
    index: &'a str,
    staging: Staging<'a>,
    prefetch: Option<&'a Prefetch>,
    payloads: &'a Payloads,
    /// Payloads to read before the rows can be evaluated.
    pub(super) unread: UnreadPayloads,
    /// The next id to assign.
    next_id: u64,
    found: Option<NeighborColumns>,
    response: v1::InsertResponse,
    /// Ids that hold another point. After the first, only further conflicts are collected.
    conflicts: Vec<u64>,
    /// New ids that a writer session reserved.
    reserved: Vec<u64>,
}

impl<'a> Evaluation<'a> {
    pub(super) fn new(
        call: &Call,
        insertion: &'a Insertion,
        hosted: &'a Hosted,
        writer: &'a Writer,
        limits: &Limits,
        prefetch: Option<&'a Prefetch>,
        payloads: &'a Payloads,
    ) -> Result<Self, Error> {
        let space = hosted.space();
        let mut budget = AnswerBudget::new(limits, call);
        // The request counts and has more bytes for each row.
        budget.take_held(insertion.rows.len() * (1 + 8))?;
        Ok(Self {
            insertion,
            index: hosted.name(),
            next_id: writer.next_id(),
            staging: Staging::new(writer, insertion.is_searched()),
            prefetch,
            payloads,
            unread: UnreadPayloads::default(),
            found: insertion
                .neighbors
                .map(|(_, include)| NeighborColumns::new(include, space.coordinates(), budget)),
            response: v1::InsertResponse::default(),
            conflicts: Vec::new(),
            reserved: Vec::new(),
        })
    }

    /// Evaluates one row: its neighbours, then its outcome.
    pub(super) fn row(&mut self, at: usize, row: &[f64]) -> Result<(), Error> {
        let insertion = self.insertion;
        let given = insertion.ids.get(at).copied();
        let id = given.unwrap_or(self.next_id);
        let tag = insertion.tags.get(at).copied().unwrap_or_default();
        let payload = insertion.payload(at);

        let held = given.and_then(|id| self.staging.held(id));
        let is_held = held.is_some();
        let is_unchanged = match held {
            Some(held) if is_same(&held, tag, row) => match self.payloads.is_stored(id, payload) {
                Some(is_stored) => is_stored,
                None => {
                    self.unread.compared.push(id);
                    true
                }
            },
            _ => false,
        };
        if !is_held && given.is_some_and(|id| self.staging.is_reserved(id)) {
            self.reserved.push(id);
        }
        if is_held && !is_unchanged && !insertion.replace {
            self.conflicts.push(id);
        }
        if !self.conflicts.is_empty() || !self.reserved.is_empty() {
            return Ok(());
        }
        if is_held {
            self.staging.hide(id);
        }
        self.answer_neighbors(at, row)?;
        let (outcome, answered_id) = if is_unchanged {
            (v1::Outcome::Unchanged, id)
        } else if let Some(blocker) = self.blocker(at, row)? {
            (v1::Outcome::TooClose, blocker)
        } else if is_held {
            (v1::Outcome::Replaced, id)
        } else {
            (v1::Outcome::Inserted, id)
        };
        self.response.outcomes.push(outcome.into());
        self.response.ids.push(answered_id);
        let outcome = match outcome {
            v1::Outcome::Inserted => Outcome::Inserted,
            v1::Outcome::Replaced => Outcome::Replaced,
            v1::Outcome::Unchanged | v1::Outcome::TooClose | v1::Outcome::Unspecified => {
                self.staging.unhide(id);
                return Ok(());
            }
        };
        if id >= END_OF_IDS {
            return Err(Error::IdsExhausted {
                index: self.index.into(),
            });
        }
        // Used only if ids are assigned.
        self.next_id += 1;
        // A copy: the request's payloads are slices that keep the whole message alive.
        let payload = Bytes::copy_from_slice(payload);
        self.staging.accept(id, tag, row, payload, outcome);
        Ok(())
    }

    fn answer_neighbors(&mut self, at: usize, row: &[f64]) -> Result<(), Error> {
        let (Some(found), Some((spec, _))) = (&mut self.found, &self.insertion.neighbors) else {
            return Ok(());
        };
        let search = spec.among(self.staging.points())?;
        let search = Search {
            k: search.k.min(found.too_many()),
            ..search
        };
        let prefetch = self.prefetch.filter(|prefetch| prefetch.reaches(&search));
        let known = known(prefetch, at, |row| &row.neighbors);
        let neighbors = self.staging.search(row, &search, known)?;
        found.push(|id| self.staging.point(id), &neighbors)?;
        for id in found.without_payload().to_vec() {
            let accepted = self.staging.accepted_payload(id);
            let payload = accepted.or_else(|| self.payloads.of_neighbor(id).cloned());
            if payload.is_none() {
                self.unread.neighbors.push(id);
            }
            found.push_payload(payload.unwrap_or_default())?;
        }
        Ok(())
    }

    /// The nearest point, if it is nearer than `min_separation`.
    fn blocker(&mut self, at: usize, row: &[f64]) -> Result<Option<u64>, Error> {
        let min_separation = self.insertion.min_separation;
        let Some(nearest) = self.insertion.nearest() else {
            return Ok(None);
        };
        let known = known(self.prefetch, at, |row| &row.nearest);
        let neighbors = self.staging.search(row, &nearest, known)?;
        let blocker = neighbors
            .first()
            .filter(|near| near.distance < min_separation);
        Ok(blocker.map(|near| near.id))
    }

    /// The effects to log, the response without its revision, and the bytes that the response holds.
    pub(super) fn finish(
        self,
    ) -> Result<(Effects, v1::InsertResponse, Option<AnswerBytes>), Error> {
        if !self.conflicts.is_empty() {
            return Err(Error::PointsExist {
                index: self.index.into(),
                ids: self.conflicts,
            });
        }
        if !self.reserved.is_empty() {
            return Err(Error::IdsReserved {
                index: self.index.into(),
                ids: self.reserved,
            });
        }
        let found = self.found.map(NeighborColumns::finish_held);
        let (neighbors, held) = found.unzip();
        let response = v1::InsertResponse {
            neighbors,
            ..self.response
        };
        Ok((self.staging.effects, response, held))
    }
}

/// The prefetched neighbours of a row.
fn known<'a>(
    prefetch: Option<&'a Prefetch>,
    at: usize,
    neighbors: impl FnOnce(&'a PrefetchedRow) -> &'a Vec<Neighbor>,
) -> Option<EarlierAnswer<'a>> {
    let prefetch = prefetch?;
    Some(EarlierAnswer {
        revision: prefetch.revision,
        neighbors: neighbors(prefetch.rows.get(at)?),
    })
}
