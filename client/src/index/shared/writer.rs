//! The pending writes of a shared index: their order, their batches, and what the copy shows of them.
//!
//! Nothing here waits or sends. The caller holds the lock of the writer, and passes the points of the copy.

use std::{
    collections::{HashMap, VecDeque},
    sync::Arc,
};

use wayfold_index::{Neighbor, Search};
use wayfold_proto::v1;

use super::{
    batch::{Batch, Step, UnsentWrite},
    ids::ReservedIds,
    meanwhile::{Answerable, Arrivals, Question},
    rebased::Rebased,
};
use crate::{
    Error,
    index::local::{LocalPoints, NewRow},
};

/// The most steps of a batch: each waits for the slowest.
const MAX_BATCH_STEPS: usize = 4_096;

/// The most bytes of a batch.
const MAX_BATCH_BYTES: usize = 1 << 20;

#[derive(Debug)]
pub(super) struct Writer {
    width: usize,
    /// The writer session, once it is open.
    pub(super) session: Option<u64>,
    pub(super) ids: ReservedIds,
    max_batch_steps: usize,
    max_batch_bytes: usize,
    /// Batches that the copy has not seen published, the oldest first.
    queue: VecDeque<Batch>,
    next_number: u64,
    /// Ids with pending writes other than inserts under ids of this session.
    rebased: HashMap<u64, Rebased>,
    /// The number of points without the pending writes.
    pub(super) published_points: usize,
    /// The bytes of `queue`.
    pub(super) bytes: usize,
    /// The ids that callers wait for.
    pub(super) wanted_ids: u64,
    /// The number of writes so far.
    pub(super) written: u64,
    /// The number of writes that the server has acknowledged, or that were given back.
    pub(super) settled: u64,
    pub(super) arrivals: Arrivals,
    /// The reason for which the server takes no more writes, until the caller has taken back those that it did not take.
    pub(super) refused: Option<Arc<Error>>,
    /// The number of refusals so far.
    pub(super) refusals: u64,
    unsent: Vec<UnsentWrite>,
    /// The sessions that were this process's before.
    past_sessions: Vec<u64>,
    /// True while the sender waits for work.
    pub(super) is_idle: bool,
    pub(super) is_closed: bool,
}

impl Writer {
    pub(super) fn new(width: usize) -> Writer {
        Writer {
            width,
            session: None,
            ids: ReservedIds::default(),
            max_batch_steps: MAX_BATCH_STEPS,
            max_batch_bytes: MAX_BATCH_BYTES,
            queue: VecDeque::new(),
            next_number: 1,
            rebased: HashMap::new(),
            published_points: 0,
            bytes: 0,
            wanted_ids: 0,
            written: 0,
            settled: 0,
            arrivals: Arrivals::default(),
            refused: None,
            refusals: 0,
            unsent: Vec::new(),
            past_sessions: Vec::new(),
            is_idle: false,
            is_closed: false,
        }
    }

    /// Keeps batches within the limits of the server.
    pub(super) fn limit(&mut self, max_rows: usize, max_request_bytes: usize) {
        self.max_batch_steps = MAX_BATCH_STEPS.min(max_rows).max(1);
        self.max_batch_bytes = MAX_BATCH_BYTES.min(max_request_bytes / 2);
    }

    /// Begins a session, whose first batch is number 1.
    pub(super) fn open(&mut self, session: u64, reserved: Option<v1::IdBlock>) {
        self.session = Some(session);
        self.ids.clear();
        self.next_number = 1;
        self.reserve(reserved);
    }

    /// True if a session is open, or writes wait for one.
    pub(super) fn has_session(&self) -> bool {
        self.session.is_some() || self.settled < self.written
    }

    /// True if a session is or was this process's.
    pub(super) fn is_own(&self, session: u64) -> bool {
        self.session == Some(session) || self.past_sessions.contains(&session)
    }

    pub(super) fn reserve(&mut self, block: Option<v1::IdBlock>) {
        let block = block.unwrap_or_default();
        self.ids
            .add(block.first_id..block.first_id.saturating_add(block.count));
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
    pub(super) fn ask(
        &mut self,
        id: u64,
        row: &[f64],
        search: &Search<'_>,
        found: &[Neighbor],
        at: u64,
    ) {
        if let Some(batch) = self.queue.back_mut() {
            let step = batch.len() - 1;
            let question = Question::new((id, step), row, search, found, at);
            batch.questions.push(question);
            self.arrivals.open();
        }
    }

    /// Changes a point that others may change too.
    pub(super) fn change(
        &mut self,
        id: u64,
        step: &Step<'_>,
        points: &mut LocalPoints,
    ) -> Result<(), Error> {
        if !self.rebased.contains_key(&id) {
            let shown = points.get(id);
            let rebased = match &shown {
                // The insert is pending too.
                Some(point) if self.is_pending_insert(id) => {
                    let mut rebased = Rebased::new(None);
                    rebased.push(&Step::Put {
                        tag: point.tag,
                        row: &point.row,
                        payload: &[],
                    });
                    rebased
                }
                _ => Rebased::new(shown.map(|point| (point.tag, point.row))),
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
            rebased.push(step);
        }
        self.push(id, step);
        Ok(())
    }

    /// True if the newest published points cannot have this id, because its insert is pending.
    fn is_pending_insert(&self, id: u64) -> bool {
        self.queue.iter().any(|batch| batch.has_assigned(id))
    }

    fn push(&mut self, id: u64, step: &Step<'_>) -> &mut Batch {
        let bytes = Batch::step_bytes(step);
        let is_full = self.queue.back().is_none_or(|batch| {
            batch.number != 0
                || batch.len() >= self.max_batch_steps
                || batch.bytes() + bytes > self.max_batch_bytes
        });
        if is_full {
            self.queue.push_back(Batch::default());
        }
        self.bytes += bytes;
        self.written += 1;
        let last = self.queue.len() - 1;
        let batch = &mut self.queue[last];
        batch.push(id, step);
        batch
    }

    /// The next batch to send, which grows no more. With `reserve_count` there is one even if no write is pending.
    pub(super) fn next(&mut self, session: u64, reserve_count: u64) -> Option<v1::WriteRequest> {
        let is_taken = |batch: &Batch| batch.revision.is_some();
        if reserve_count > 0 && self.queue.iter().all(is_taken) {
            self.queue.push_back(Batch::default());
        }
        let batch = self.queue.iter_mut().find(|batch| !is_taken(batch))?;
        if batch.number == 0 {
            batch.number = self.next_number;
            batch.session = session;
            batch.reserve_count = reserve_count;
            self.next_number += 1;
        }
        Some(batch.message())
    }

    /// The server has taken a batch of the session and made this revision of it; the copy has reached revision
    /// `published`.
    pub(super) fn acknowledge(
        &mut self,
        number: u64,
        revision: u64,
        published: u64,
        points: &mut LocalPoints,
    ) -> Result<Vec<Answerable>, Error> {
        let session = self.session.unwrap_or(0);
        let is_it = |batch: &&mut Batch| batch.session == session && batch.number == number;
        let Some(batch) = self.queue.iter_mut().find(is_it) else {
            return Ok(Vec::new());
        };
        if batch.revision.replace(revision).is_none() {
            self.settled += batch.len() as u64;
        }
        // The copy was read at a later revision, so its feed does not name the batch.
        self.confirm_up_to(published, points)
    }

    /// Confirms the batches that were published up to a revision which the copy has.
    fn confirm_up_to(
        &mut self,
        published: u64,
        points: &mut LocalPoints,
    ) -> Result<Vec<Answerable>, Error> {
        let mut answerable = Vec::new();
        while let Some(first) = self.queue.front()
            && first.revision.is_some_and(|revision| revision <= published)
        {
            answerable.extend(self.confirm_first(true, points)?);
        }
        Ok(answerable)
    }

    /// The feed has reached the own batch of this number. None if it waits for no such batch.
    pub(super) fn confirm(
        &mut self,
        session: u64,
        number: u64,
        points: &mut LocalPoints,
    ) -> Result<Option<Vec<Answerable>>, Error> {
        let is_it = |batch: &Batch| batch.session == session && batch.number == number;
        let Some(at) = self.queue.iter().position(is_it) else {
            return Ok(None);
        };
        let mut answerable = Vec::new();
        // The feed does not name a batch that was published before the copy was read.
        for _ in 0..at {
            answerable.extend(self.confirm_first(true, points)?);
        }
        answerable.extend(self.confirm_first(false, points)?);
        Ok(Some(answerable))
    }

    /// The oldest batch is published; the copy's points have it already if they are newer.
    fn confirm_first(
        &mut self,
        is_newer: bool,
        points: &mut LocalPoints,
    ) -> Result<Option<Answerable>, Error> {
        let Some(mut batch) = self.queue.pop_front() else {
            return Ok(None);
        };
        self.bytes -= batch.bytes();
        if batch.revision.is_none() {
            self.settled += batch.len() as u64;
        }
        let mut questions = std::mem::take(&mut batch.questions);
        if self.rebased.is_empty() && questions.is_empty() {
            // The steps are inserts under ids of this session.
            self.published_points += if is_newer { 0 } else { batch.len() };
            return Ok(None);
        }
        let mut unplaced = questions.iter_mut().peekable();
        for (at, (id, _)) in batch.steps(self.width).enumerate() {
            if let Some(question) = unplaced.next_if(|question| question.step == at) {
                question.points_before = self.published_points;
            }
            let Some(rebased) = self.rebased.get_mut(&id) else {
                self.published_points += usize::from(!is_newer);
                continue;
            };
            let was_stored = rebased.base.is_some();
            let is_settled = rebased.confirm(is_newer);
            self.published_points += usize::from(rebased.base.is_some());
            self.published_points -= usize::from(was_stored);
            if is_newer {
                show(id, rebased, points)?;
            }
            if is_settled {
                self.rebased.remove(&id);
            }
        }
        let oldest = self.queue.iter().find_map(|batch| batch.questions.first());
        Ok(self.arrivals.answerable(questions, oldest, points))
    }

    /// Another writer has removed and stored points, as one record.
    pub(super) fn apply<'a>(
        &mut self,
        stored: impl Iterator<Item = NewRow<'a>>,
        removed: &[u64],
        points: &mut LocalPoints,
    ) -> Result<(), Error> {
        if self.rebased.is_empty() && !self.arrivals.are_wanted() {
            return self.publish(stored, removed, points);
        }
        let at = points.seen().0 + 1;
        let mut plain = Vec::new();
        for row in stored {
            let held = if row.is_new { None } else { points.get(row.id) };
            self.arrivals.push(at, row.id, held.map(|held| held.tag));
            match self.rebased.get_mut(&row.id) {
                None => plain.push(row),
                Some(rebased) => {
                    let was_stored = rebased.base.is_some();
                    self.published_points += usize::from(!was_stored);
                    rebased.base = Some((row.tag, row.row.to_vec()));
                    show(row.id, rebased, points)?;
                }
            }
        }
        let mut plain_removed = Vec::new();
        for &id in removed {
            match self.rebased.get_mut(&id) {
                None => plain_removed.push(id),
                Some(rebased) => {
                    let was_stored = rebased.base.take().is_some();
                    self.published_points -= usize::from(was_stored);
                    show(id, rebased, points)?;
                }
            }
        }
        self.publish(plain.into_iter(), &plain_removed, points)
    }

    /// Stores and removes points on which no write is pending.
    fn publish<'a>(
        &mut self,
        stored: impl Iterator<Item = NewRow<'a>>,
        removed: &[u64],
        points: &mut LocalPoints,
    ) -> Result<(), Error> {
        let shown = points.forest.len();
        points.apply(stored, removed)?;
        self.published_points = self.published_points + points.forest.len() - shown;
        Ok(())
    }

    /// The copy was read again, at a revision: applies the pending writes to it. The server may have taken some of the
    /// others before.
    pub(super) fn reloaded(
        &mut self,
        revision: u64,
        points: &mut LocalPoints,
    ) -> Result<Vec<Answerable>, Error> {
        self.rebased.clear();
        self.published_points = points.forest.len();
        for question in self.queue.iter_mut().flat_map(|batch| &mut batch.questions) {
            question.reloaded();
        }
        let answerable = self.confirm_up_to(revision, points)?;
        for batch in &self.queue {
            for (id, step) in batch.steps(self.width) {
                let base = || points.get(id).map(|point| (point.tag, point.row));
                let rebased = self
                    .rebased
                    .entry(id)
                    .or_insert_with(|| Rebased::new(base()));
                rebased.push(&step);
            }
        }
        for (&id, rebased) in &self.rebased {
            show(id, rebased, points)?;
        }
        Ok(answerable)
    }

    /// The server refused the oldest batch that it has not taken, for good: takes all writes from there on out of the
    /// copy, and keeps them for the caller. Batches that it has taken wait for the feed as before.
    pub(super) fn refuse(
        &mut self,
        why: Arc<Error>,
        points: &mut LocalPoints,
    ) -> Result<(), Error> {
        self.refused.get_or_insert(why);
        self.refusals += 1;
        self.past_sessions.extend(self.session.take());
        self.ids.clear();
        let is_taken = |batch: &Batch| batch.revision.is_some();
        let taken = self
            .queue
            .iter()
            .take_while(|batch| is_taken(batch))
            .count();
        for batch in self.queue.split_off(taken) {
            self.bytes -= batch.bytes();
            self.arrivals.close(batch.questions.len());
            self.settled += batch.len() as u64;
            for (id, _) in batch.steps(self.width) {
                match self.rebased.get_mut(&id) {
                    // An insert under an id of this session.
                    None => drop(points.remove(id)?),
                    Some(rebased) => {
                        let is_settled = rebased.give_up();
                        show(id, rebased, points)?;
                        if is_settled {
                            self.rebased.remove(&id);
                        }
                    }
                }
            }
            self.unsent.extend(batch.unsent(self.width));
        }
        Ok(())
    }

    /// The index was made again: nothing that was sent or published of it counts any more.
    pub(super) fn forget_history(&mut self) {
        self.past_sessions.clear();
        for batch in self.queue.drain(..) {
            self.arrivals.close(batch.questions.len());
        }
        self.rebased.clear();
        self.bytes = 0;
    }

    /// The writes that the server did not take, in their order. Writing may begin again.
    pub(super) fn take_unsent(&mut self) -> Vec<UnsentWrite> {
        self.refused = None;
        std::mem::take(&mut self.unsent)
    }

    /// The payload that the last pending write of this id gives it.
    pub(super) fn payload(&self, id: u64) -> Option<Vec<u8>> {
        let batches = self.queue.iter().rev();
        batches
            .filter_map(|batch| batch.payload(self.width, id))
            .next()
    }
}

/// Makes the copy hold what an id shows.
fn show(id: u64, rebased: &Rebased, points: &mut LocalPoints) -> Result<(), Error> {
    match rebased.shown() {
        None => drop(points.remove(id)?),
        Some((tag, row)) => match points.get(id) {
            Some(held) if held.row == row => {
                if held.tag != tag {
                    points.set_tag(id, tag)?;
                }
            }
            _ => points.store(id, tag, &row)?,
        },
    }
    Ok(())
}

#[cfg(test)]
#[path = "writer_tests.rs"]
mod tests;
