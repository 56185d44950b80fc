//! The pending writes of a shared index: their order, their batches, and what the copy shows of them.
//!
//! Nothing here waits or sends. The caller holds the lock of [`PendingWrites`], and passes the points of the copy.

mod batching;
mod outcome;

use std::{
    collections::{BTreeMap, HashMap, HashSet, VecDeque},
    sync::Arc,
};

use wayfold_index::Neighbor;
use wayfold_proto::v1;

use super::{
    batch::{Batch, Step, UnsentWrite},
    ids::ReservedIds,
    meanwhile::{InsertSearch, OpenSearch, OpenSearches},
    rebased::RebasedPoint,
};
use crate::{
    Error, Limits,
    index::local::{LocalPoints, NewRow},
};

/// The ids that are reserved at once, unless the server reserves fewer. The next ones are asked for when half are left.
const ID_BLOCK: u64 = 1 << 16;

/// About as many bytes as a step on a rebased point takes, besides the rows of the point and of the step.
const REBASED_STEP_BYTES: usize = 256;

#[derive(Debug)]
pub(super) struct PendingWrites {
    width: usize,
    /// The writer session, once it is open.
    pub(super) session: Option<u64>,
    pub(super) ids: ReservedIds,
    /// The limits of the server, as far as they are known.
    pub(super) limits: Limits,
    /// Batches that the copy has not seen published, the oldest first.
    queue: VecDeque<Batch>,
    next_number: u64,
    /// Ids with pending writes other than inserts under ids of this session.
    rebased: HashMap<u64, RebasedPoint>,
    /// The number of points without the pending writes.
    pub(super) published_points: usize,
    /// The bytes that this process holds for `queue`.
    pub(super) bytes: usize,
    /// The most ids that a waiting caller needs at once.
    pub(super) requested_ids: u64,
    /// The number of writes so far.
    pub(super) written: u64,
    /// The number of writes that the server has acknowledged, or that were given back.
    pub(super) resolved: u64,
    pub(super) open_searches: OpenSearches,
    /// The reason for which the server takes no more writes, until the caller has taken back those that it did not
    /// take.
    pub(super) refused: Option<Arc<Error>>,
    /// The reason of the last refusal, also after the caller has taken back the writes.
    last_refusal: Option<Arc<Error>>,
    /// The number of refusals so far.
    pub(super) refusals: u64,
    /// The writes that the server did not take, until the caller takes them back.
    pub(super) unsent: Vec<UnsentWrite>,
    /// The sessions that were this process's before.
    past_sessions: Vec<u64>,
    /// True while the sender waits for work.
    pub(super) is_idle: bool,
    pub(super) is_closed: bool,
}

impl PendingWrites {
    pub(super) fn new(width: usize) -> PendingWrites {
        PendingWrites {
            width,
            session: None,
            ids: ReservedIds::default(),
            limits: Limits::NONE,
            queue: VecDeque::new(),
            next_number: 1,
            rebased: HashMap::new(),
            published_points: 0,
            bytes: 0,
            requested_ids: 0,
            written: 0,
            resolved: 0,
            open_searches: OpenSearches::default(),
            refused: None,
            last_refusal: None,
            refusals: 0,
            unsent: Vec::new(),
            past_sessions: Vec::new(),
            is_idle: false,
            is_closed: false,
        }
    }

    /// The number of ids that are reserved at once.
    pub(super) fn id_block(&self) -> u64 {
        ID_BLOCK.min(self.limits.max_reserved_ids)
    }

    /// The number of ids to reserve now.
    pub(super) fn reserve_count(&self) -> u64 {
        let id_block = self.id_block();
        match self.ids.len() {
            left if left < self.requested_ids => {
                let missing = self.requested_ids - left;
                missing.clamp(id_block, self.limits.max_reserved_ids)
            }
            left if left < id_block / 2 => id_block,
            _ => 0,
        }
    }

    /// Begins a session, whose first batch is number 1. `ids` keeps those that the caller chose since the last session.
    pub(super) fn open(&mut self, session: u64, reserved: Option<v1::IdBlock>) {
        self.session = Some(session);
        self.next_number = 1;
        self.reserve(reserved);
    }

    /// True if a session is open, or writes wait for one.
    pub(super) fn has_session(&self) -> bool {
        self.session.is_some() || self.resolved < self.written
    }

    /// The number of writes that the copy has not seen published.
    pub(super) fn unpublished(&self) -> usize {
        self.queue.iter().map(Batch::len).sum()
    }

    /// True if a session is or was this process's.
    pub(super) fn is_own(&self, session: u64) -> bool {
        self.session == Some(session) || self.past_sessions.contains(&session)
    }

    pub(super) fn reserve(&mut self, block: Option<v1::IdBlock>) {
        let block = block.unwrap_or_default();
        self.ids
            .add(block.first_id..block.first_id.saturating_add(block.id_count));
    }

    /// Stores a point under an id of this session, which no one else uses.
    pub(super) fn insert(
        &mut self,
        id: u64,
        step: &Step<'_>,
        points: &mut LocalPoints,
    ) -> Result<(), Error> {
        if let Step::Put { tag, row, .. } = *step {
            points.store(id, tag, row)?;
        }
        self.push(id, step).assign(id);
        Ok(())
    }

    /// Notes the search of the insert that was pushed last, and what it found.
    pub(super) fn note_search(
        &mut self,
        id: u64,
        row: &[f64],
        search: &InsertSearch<'_>,
        found: &[Neighbor],
        change: u64,
    ) {
        if let Some(batch) = self.queue.back_mut() {
            let step = batch.len() - 1;
            let open = OpenSearch::new((id, step), row, search, found, change);
            batch.kept_bytes += open.bytes();
            self.bytes += open.bytes();
            batch.searches.push(open);
            self.open_searches.open();
        }
    }

    /// Changes a point that others may change too.
    pub(super) fn change(
        &mut self,
        id: u64,
        step: &Step<'_>,
        points: &mut LocalPoints,
    ) -> Result<(), Error> {
        let visible_from = points.read_revision().0 + 1;
        if !self.rebased.contains_key(&id) {
            let shown = points.get(id);
            let rebased = match &shown {
                // The insert is pending too.
                Some(point) if self.is_pending_insert(id) => {
                    let mut rebased = RebasedPoint::new(None);
                    let insert = Step::Put {
                        tag: point.tag,
                        row: &point.row,
                        payload: &[],
                    };
                    rebased.push(&insert, visible_from);
                    rebased
                }
                _ => RebasedPoint::new(shown.map(|point| (point.tag, point.row))),
            };
            self.rebased.insert(id, rebased);
        }
        match *step {
            Step::Put { tag, row, .. } => points.store(id, tag, row)?,
            Step::Replace { row } => {
                if let Some(point) = points.get(id) {
                    points.store(id, point.tag, row)?;
                }
            }
            Step::Remove => drop(points.remove(id)?),
            Step::SetTag(tag) => drop(points.set_tag(id, tag)?),
            Step::SetPayload(_) => drop(points.touch(id)?),
        }
        if let Some(rebased) = self.rebased.get_mut(&id) {
            rebased.push(step, visible_from);
        }
        let bytes = self.rebased_step_bytes();
        let batch = self.push(id, step);
        batch.kept_bytes += bytes;
        if matches!(step, Step::Put { .. }) {
            batch.chosen_ids.push(id);
        }
        self.bytes += bytes;
        Ok(())
    }

    /// Keeps the pending writes for a copy that was read again. The copy lacks an insert that was never sent, which is
    /// stored like a new one: thousands wait if the server was away, and each rebased point takes several times its bytes.
    fn rebase_all(&mut self, change: u64, points: &mut LocalPoints) -> Result<(), Error> {
        let reserved = &self.ids;
        let is_plain = |batch: &Batch, id: u64, step: &Step<'_>| {
            let is_put = matches!(step, Step::Put { .. });
            is_put && batch.number == 0 && batch.may_have_assigned(id) && reserved.contains(id)
        };
        let mut changed = HashSet::new();
        for batch in &self.queue {
            let steps = batch.steps(self.width);
            let others = steps.filter(|(id, step)| !is_plain(batch, *id, step));
            changed.extend(others.map(|(id, _)| id));
        }
        let mut plain = Vec::new();
        for (id, step) in self.queue.iter().flat_map(|batch| batch.steps(self.width)) {
            match step {
                Step::Put { tag, row, .. } if !changed.contains(&id) => plain.push(NewRow {
                    id,
                    tag,
                    row,
                    is_new: true,
                }),
                step => {
                    let base = || points.get(id).map(|point| (point.tag, point.row));
                    let rebased = self.rebased.entry(id);
                    let rebased = rebased.or_insert_with(|| RebasedPoint::new(base()));
                    rebased.push(&step, change);
                }
            }
        }
        if !plain.is_empty() {
            points.apply(plain.into_iter(), &[])?;
        }
        let step_bytes = self.rebased_step_bytes();
        for batch in &mut self.queue {
            let ids = batch.ids().iter();
            let rebased = ids.filter(|&id| self.rebased.contains_key(id)).count();
            let searches: usize = batch.searches.iter().map(OpenSearch::bytes).sum();
            self.bytes -= batch.kept_bytes;
            batch.kept_bytes = searches + rebased * step_bytes;
            self.bytes += batch.kept_bytes;
        }
        Ok(())
    }

    /// About as many bytes as a step on a rebased point takes.
    fn rebased_step_bytes(&self) -> usize {
        REBASED_STEP_BYTES + 2 * size_of::<f64>() * self.width
    }

    /// True if the newest published points cannot have this id, because its insert is pending.
    fn is_pending_insert(&self, id: u64) -> bool {
        self.queue.iter().any(|batch| batch.has_assigned(id))
    }

    /// The writes that the server did not take, in their order. Writing may begin again.
    pub(super) fn take_unsent(&mut self) -> Vec<UnsentWrite> {
        self.refused = None;
        std::mem::take(&mut self.unsent)
    }

    /// The error of a caller whose writes the last refusal gave back.
    pub(super) fn refusal(&self) -> Error {
        let why = self.last_refusal.clone();
        let why = why.unwrap_or_else(|| Arc::new(Error::Closed));
        Error::WritesRefused { why }
    }

    /// The payloads that pending writes give to these ids; none for an id whose payload no pending write sets.
    pub(super) fn payloads(&self, ids: impl Iterator<Item = u64>) -> BTreeMap<u64, Option<&[u8]>> {
        let may_be_pending = |id: &u64| {
            let mut batches = self.queue.iter();
            self.rebased.contains_key(id) || batches.any(|batch| batch.may_have_assigned(*id))
        };
        let ids = ids.filter(may_be_pending);
        let mut payloads: BTreeMap<_, _> = ids.map(|id| (id, None)).collect();
        if payloads.is_empty() {
            return payloads;
        }
        // One pass for all ids: the caller holds the lock, and the queue is long if the server is away.
        for (id, step) in self.queue.iter().flat_map(|batch| batch.steps(self.width)) {
            if let Some(payload) = step.payload()
                && let Some(last) = payloads.get_mut(&id)
            {
                *last = Some(payload);
            }
        }
        payloads
    }
}

#[cfg(test)]
mod tests;
