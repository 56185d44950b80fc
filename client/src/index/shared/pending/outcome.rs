//! The outcome of pending writes: the server acknowledges, publishes or refuses them.

use std::{
    collections::{BTreeMap, HashMap},
    sync::Arc,
};

use super::{Batch, PendingWrites, RebasedPoint};
use crate::{
    Error,
    index::{
        local::{LocalPoints, NewRow},
        shared::{
            meanwhile::{Answerable, Reloaded, Versions},
            rebased::Difference,
        },
    },
};

impl PendingWrites {
    /// The server has taken a batch of the session and made this revision of it; the copy has reached revision
    /// `published`.
    pub(in crate::index::shared) fn acknowledge(
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
            self.resolved += batch.len() as u64;
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
    pub(in crate::index::shared) fn confirm(
        &mut self,
        session: u64,
        number: u64,
        points: &mut LocalPoints,
    ) -> Result<Option<Vec<Answerable>>, Error> {
        let is_it = |batch: &Batch| batch.session == session && batch.number == number;
        let Some(position) = self.queue.iter().position(is_it) else {
            return Ok(None);
        };
        let mut answerable = Vec::new();
        // The feed does not name a batch that was published before the copy was read.
        for _ in 0..position {
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
        self.bytes -= batch.held_bytes();
        if batch.revision.is_none() {
            self.resolved += batch.len() as u64;
        }
        let mut searches = std::mem::take(&mut batch.searches);
        if is_newer {
            searches
                .iter_mut()
                .for_each(|open| open.revision = batch.revision);
        }
        if self.rebased.is_empty() && searches.is_empty() {
            // The steps are inserts under ids of this session.
            self.published_points += if is_newer { 0 } else { batch.len() };
            return Ok(None);
        }
        // Steps of the batch change these ids: the content that is published before each of the steps.
        let mut before: HashMap<u64, Versions> = HashMap::new();
        let first = searches.first().map_or(usize::MAX, |open| open.step);
        let mut unplaced = searches.iter_mut().peekable();
        for (step, (id, _)) in batch.steps(self.width).enumerate() {
            if let Some(open) = unplaced.next_if(|open| open.step == step) {
                open.points_before = self.published_points;
            }
            let Some(rebased) = self.rebased.get_mut(&id) else {
                self.published_points += usize::from(!is_newer);
                continue;
            };
            if step > first {
                let base = rebased.base.clone();
                before.entry(id).or_default().push((step, base));
            }
            let was_stored = rebased.base.is_some();
            if is_newer && let Some(difference) = rebased.difference_once_confirmed() {
                // Later searches saw the own write, and not the newer ones of others.
                let change = points.read_revision().0 + 1;
                self.open_searches.depart(change);
                if was_stored {
                    self.open_searches.push(change, id, difference);
                }
            }
            let was_last = rebased.confirm(is_newer);
            self.published_points += usize::from(rebased.base.is_some());
            self.published_points -= usize::from(was_stored);
            if is_newer {
                show(id, rebased, points)?;
            }
            if was_last {
                self.rebased.remove(&id);
            }
        }
        let later = || {
            let batches = std::iter::once(&batch).chain(&self.queue);
            batches
                .flat_map(|batch| batch.ids().iter().copied())
                .collect()
        };
        let oldest = self.queue.iter().find_map(|batch| batch.searches.first());
        let published = |id| {
            let last = match self.rebased.get(&id) {
                Some(rebased) => rebased.base.clone(),
                None => points.get(id).map(|point| (point.tag, point.row)),
            };
            let mut versions = before.remove(&id).unwrap_or_default();
            versions.push((usize::MAX, last));
            versions
        };
        let (space, snapshot) = (points.forest.space(), || points.forest.snapshot());
        Ok(self
            .open_searches
            .answerable(space, searches, later, oldest, published, snapshot))
    }

    /// Another writer has removed and stored points, as one record.
    pub(in crate::index::shared) fn apply<'a>(
        &mut self,
        stored: impl Iterator<Item = NewRow<'a>>,
        removed: &[u64],
        points: &mut LocalPoints,
    ) -> Result<(), Error> {
        if self.rebased.is_empty() && !self.open_searches.are_open() {
            return self.publish(stored, removed, points);
        }
        let change = points.read_revision().0 + 1;
        let mut plain = Vec::new();
        for row in stored {
            let held = if row.is_new { None } else { points.get(row.id) };
            let is_departure = match (self.rebased.get(&row.id), &held) {
                // A later pending write may hide the point that an insert found.
                (Some(rebased), _) => rebased.is_changed_by(&row),
                (None, Some(held)) => held.tag != row.tag,
                (None, None) => row.is_new && points.forest.contains(row.id),
            };
            if is_departure {
                self.open_searches.depart(change);
            }
            let difference = match self.rebased.get(&row.id) {
                // The copy shows own writes too, which a search may precede.
                Some(rebased) => rebased.difference(&row),
                None => Difference::plain(held.map(|held| held.tag)),
            };
            self.open_searches.push(change, row.id, difference);
            match self.rebased.get_mut(&row.id) {
                None => plain.push(row),
                Some(rebased) => {
                    let was_stored = rebased.base.is_some();
                    self.published_points += usize::from(!was_stored);
                    rebased.base = Some((row.tag, row.row.to_vec()));
                    show_again(row.id, rebased, points)?;
                }
            }
        }
        if !removed.is_empty() {
            self.open_searches.depart(change);
        }
        self.limit_arrivals();
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

    /// Answers the open searches from all points, if those of others take too much memory.
    fn limit_arrivals(&mut self) {
        if self.open_searches.is_full() {
            self.open_searches.forget();
            for open in self.queue.iter_mut().flat_map(|batch| &mut batch.searches) {
                open.search_all();
            }
        }
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

    /// The copy was read again, at a revision and with these changes: applies the pending writes to it. The server may have
    /// taken some of the others before.
    pub(in crate::index::shared) fn reloaded(
        &mut self,
        revision: u64,
        changes: &Reloaded,
        points: &mut LocalPoints,
    ) -> Result<Vec<Answerable>, Error> {
        let change = points.read_revision().0;
        if self.open_searches.are_open() {
            let missing = self.may_be_missing(revision);
            self.compare_rebased(&missing, points);
            let mut departed = changes.departed.iter();
            if departed.any(|id| missing.binary_search(id).is_err()) {
                self.open_searches.depart(change);
            }
        }
        self.rebased.clear();
        self.published_points = points.forest.len();
        for open in self.queue.iter_mut().flat_map(|batch| &mut batch.searches) {
            open.reload(change);
        }
        self.open_searches.reload(change, changes);
        self.limit_arrivals();
        let answerable = self.confirm_up_to(revision, points)?;
        self.rebase_all(change, points)?;
        for (&id, rebased) in &self.rebased {
            show(id, rebased, points)?;
        }
        Ok(answerable)
    }

    /// Notes each point with pending writes that the new copy lacks or has in another form: a search before such a write
    /// may have seen a point that the old copy showed no more. The copy may lack the points `missing`.
    fn compare_rebased(&mut self, missing: &[u64], points: &LocalPoints) {
        let change = points.read_revision().0;
        for (&id, rebased) in &self.rebased {
            match points.get(id) {
                Some(point) if rebased.may_have_shown_other((point.tag, &point.row[..])) => {
                    self.open_searches.depart(change);
                    self.open_searches.push_unplaced(change, id);
                }
                // The old copy did not show it.
                None if rebased.shown().is_none() && missing.binary_search(&id).is_err() => {
                    self.open_searches.depart(change);
                }
                _ => {}
            }
        }
    }

    /// The ids of the points, in ascending order, that the copy of this revision may lack because it was read before the own
    /// inserts. If the answer to an insert is missing, the confirmation of its batch tells.
    fn may_be_missing(&self, revision: u64) -> Vec<u64> {
        let is_later = |batch: &&Batch| batch.revision.is_none_or(|own| own > revision);
        let later = self.queue.iter().filter(is_later);
        let mut ids: Vec<u64> = later.flat_map(|batch| batch.assigned_ids()).collect();
        ids.sort_unstable();
        ids
    }

    /// The server refused the oldest batch that it has not taken, for good: takes all writes from there on out of the
    /// copy, and keeps them for the caller. Batches that it has taken wait for the feed as before.
    pub(in crate::index::shared) fn refuse(
        &mut self,
        why: Arc<Error>,
        points: &mut LocalPoints,
    ) -> Result<(), Error> {
        // The caller may write again before the server is asked for its limits.
        if let Some(lowered) = self.limits.lowered(&why) {
            self.limits = lowered;
        }
        let why = self.refused.get_or_insert(why);
        self.last_refusal = Some(Arc::clone(why));
        self.refusals += 1;
        self.past_sessions.extend(self.session.take());
        self.ids.clear();
        let is_taken = |batch: &Batch| batch.revision.is_some();
        let taken = self
            .queue
            .iter()
            .take_while(|batch| is_taken(batch))
            .count();
        let mut given_up = BTreeMap::new();
        for batch in self.queue.split_off(taken) {
            self.bytes -= batch.held_bytes();
            self.open_searches.close(batch.searches.len());
            self.resolved += batch.len() as u64;
            for (id, _) in batch.steps(self.width) {
                match self.rebased.get_mut(&id) {
                    // An insert under an id of this session.
                    None => drop(points.remove(id)?),
                    Some(rebased) => drop(given_up.insert(id, rebased.give_up())),
                }
            }
            self.unsent.extend(batch.unsent(self.width));
        }
        // Once an id: this applies all of its other pending writes.
        for (id, was_last) in given_up {
            if let Some(rebased) = self.rebased.get(&id) {
                show_again(id, rebased, points)?;
            }
            if was_last {
                self.rebased.remove(&id);
            }
        }
        Ok(())
    }

    /// The index was made again: nothing that was sent or published of it counts any more.
    pub(in crate::index::shared) fn forget_history(&mut self) {
        self.past_sessions.clear();
        for batch in self.queue.drain(..) {
            self.open_searches.close(batch.searches.len());
        }
        self.rebased.clear();
        self.bytes = 0;
    }
}

/// Makes the copy hold what an id shows.
fn show(id: u64, rebased: &RebasedPoint, points: &mut LocalPoints) -> Result<(), Error> {
    match rebased.shown() {
        None => drop(points.remove(id)?),
        Some((tag, row)) => match points.get(id) {
            Some(held) if held.row == row => {
                if held.tag != tag {
                    points.set_tag(id, tag)?;
                }
            }
            _ => points.store(id, tag, row)?,
        },
    }
    Ok(())
}

/// Like [`show`], and counts the id as changed even if its tag and state are equal: its payload may differ.
fn show_again(id: u64, rebased: &RebasedPoint, points: &mut LocalPoints) -> Result<(), Error> {
    let before = points.read_revision();
    show(id, rebased, points)?;
    if points.read_revision() == before {
        points.touch(id)?;
    }
    Ok(())
}
