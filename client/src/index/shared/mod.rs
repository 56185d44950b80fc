//! The form of an index that many processes share: a copy in this process, whose writes travel in the background.
//!
//! `core` is what callers and the two tasks share: the points of the copy, and the pending writes (`pending`): their
//! batches (`batch`), the ids to give (`ids`), what is published under ids with pending writes (`rebased`) and the
//! searches whose answers are not complete (`meanwhile`). `sender` sends the batches, `subscriber` applies what the
//! server publishes; both call the server through `link`, over gRPC or Zenoh.

mod batch;
mod core;
mod ids;
mod link;
mod meanwhile;
mod open;
mod pending;
mod rebased;
mod sender;
mod status;
mod subscriber;
#[cfg(test)]
mod tests;

pub use batch::UnsentWrite;
pub(super) use core::Core;
pub use meanwhile::{Meanwhile, MeanwhileAnswers};
pub use open::OpenShared;
pub use status::ConnectionStatus;

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use tokio::task::AbortHandle;
use wayfold_index::{
    Changes, NearestNeighbors, Neighbor, NewPoint, Point, ReadRevision, ScaledSearch,
    ScannedPoints, Space,
};

use super::{
    local::{self, check_id},
    runtime::wait_for,
    scan::scan,
};
use crate::Error;
use batch::{Batch, Step};
use meanwhile::InsertSearch;

/// The most rows that `insert_many` stores at once: readers wait for them.
const MAX_ROWS_AT_ONCE: usize = 4_096;

/// A shared index. Its tasks end with it.
#[derive(Debug)]
pub(super) struct SharedIndex {
    pub(super) core: Arc<Core>,
    tasks: [AbortHandle; 2],
}

impl SharedIndex {
    /// Stores new points, and returns the number of refusals before. Fails if that is not `before`: the rows before these
    /// were given back.
    fn insert_rows(
        &self,
        rows: &[f64],
        ids: &mut Vec<u64>,
        before: Option<u64>,
    ) -> Result<u64, Error> {
        let width = self.core.space.coordinates();
        let count = rows.len() / width;
        let bytes = count * Batch::step_bytes(&plain_put(&rows[..width]));
        let mut writes = self.core.room(bytes, count as u64)?;
        let refusals = writes.refusals;
        if before.is_some_and(|before| before != refusals) {
            return Err(writes.refusal());
        }
        let mut points = self.core.points.write();
        for row in rows.chunks_exact(width) {
            let id = writes.ids.next().ok_or(Error::Closed)?;
            writes.insert(id, &plain_put(row), &mut points)?;
            ids.push(id);
        }
        self.core.end_write(&mut writes, &mut points);
        Ok(refusals)
    }

    /// Refuses a payload that the server would not take.
    fn check_payload(&self, payload: &[u8]) -> Result<(), Error> {
        if payload.is_empty() {
            return Ok(());
        }
        let (max, found) = (self.core.max_payload_bytes()?, payload.len());
        match found > max {
            true => Err(Error::Argument {
                field: "payload",
                problem: format!("{found} bytes; it has at most {max}"),
            }),
            false => Ok(()),
        }
    }

    /// Changes a stored point; false if the copy has none with this id.
    fn change(&self, id: u64, step: &Step<'_>) -> Result<bool, Error> {
        // A change without effect does not wait for room.
        if !self.core.contains(id)? {
            return Ok(false);
        }
        let mut writes = self.core.room(Batch::step_bytes(step), 0)?;
        let mut points = self.core.points.write();
        if !points.forest.contains(id) {
            return Ok(false);
        }
        writes.change(id, step, &mut points)?;
        self.core.end_write(&mut writes, &mut points);
        Ok(true)
    }
}

impl NearestNeighbors for SharedIndex {
    type Error = Error;

    fn space(&self) -> &Space {
        &self.core.space
    }

    fn len(&self) -> Result<usize, Error> {
        self.core.check_readable()?;
        Ok(self.core.points.read().forest.len())
    }

    fn search(
        &self,
        row: &[f64],
        scaled: &ScaledSearch<'_>,
        found: &mut Vec<Neighbor>,
    ) -> Result<ReadRevision, Error> {
        self.core.check_readable()?;
        local::search(self.core.points.read(), row, scaled, found)
    }

    fn search_many(
        &self,
        rows: &[f64],
        searches: &[ScaledSearch<'_>],
    ) -> Result<Vec<(Vec<Neighbor>, ReadRevision)>, Error> {
        self.core.check_readable()?;
        local::search_many(self.core.points.read(), rows, searches)
    }

    fn insert(
        &self,
        point: &NewPoint<'_>,
        scaled: Option<&ScaledSearch<'_>>,
        found: &mut Vec<Neighbor>,
    ) -> Result<(u64, ReadRevision), Error> {
        check_id(point)?;
        self.check_payload(point.payload)?;
        let step = Step::Put {
            tag: point.tag,
            row: point.row,
            payload: point.payload,
        };
        let bytes = Batch::step_bytes(&step);
        let mut writes = self.core.room(bytes, u64::from(point.id.is_none()))?;
        found.clear();
        let mut search = None;
        {
            // Only the holder of this lock changes the points, so the answer holds until the point is stored.
            let points = self.core.points.read();
            if let Some(id) = point.id
                && (points.forest.contains(id) || writes.ids.contains(id))
            {
                return Err(Error::IdTaken { id });
            }
            if let Some(scaled) = scaled {
                let (size, dimension) = (points.forest.len(), self.core.space.dimension());
                let asked = InsertSearch::new(scaled, size, dimension);
                *found = points.forest.search(point.row, &asked.search)?.neighbors;
                search = Some(asked);
            }
        }
        let id = match point.id {
            Some(id) => id,
            None => writes.ids.next().ok_or(Error::Closed)?,
        };
        let mut points = self.core.points.write();
        match point.id {
            None => writes.insert(id, &step, &mut points)?,
            Some(_) => {
                writes.change(id, &step, &mut points)?;
                writes.ids.note_caller_id(id);
                let unpublished = writes.unpublished();
                writes.ids.forget_published(unpublished);
            }
        }
        let read_revision = points.read_revision();
        if let Some(search) = search {
            writes.note_search(id, point.row, &search, found, read_revision.0);
            // The others wait for the point's place in the order.
            let answer_len = search.answer_len(found);
            found.truncate(answer_len);
        }
        self.core.end_write(&mut writes, &mut points);
        Ok((id, read_revision))
    }

    fn insert_many(&self, rows: &[f64]) -> Result<Vec<u64>, Error> {
        let width = self.core.space.coordinates();
        let count = rows.len() / width;
        if count == 0 {
            drop(self.core.room(0, 0)?);
        }
        let (mut ids, mut refusals) = (Vec::with_capacity(count), None);
        let step_bytes = Batch::step_bytes(&plain_put(rows.get(..width).unwrap_or_default()));
        // A part that needs nearly all the room would wait until no other thread has a write pending.
        let max_rows = self.core.settings.max_pending_bytes / 4 / step_bytes;
        for part in rows.chunks(max_rows.clamp(1, MAX_ROWS_AT_ONCE) * width) {
            let done = ids.len();
            match self.insert_rows(part, &mut ids, refusals) {
                Ok(before) => refusals = Some(before),
                Err(error) if done == 0 => return Err(error),
                Err(error) => {
                    ids.truncate(done);
                    return Err(Error::Partial {
                        done,
                        rows: count,
                        ids,
                        source: Box::new(error),
                    });
                }
            }
        }
        Ok(ids)
    }

    fn replace(&self, id: u64, row: &[f64]) -> Result<bool, Error> {
        self.change(id, &Step::Replace { row })
    }

    fn remove(&self, id: u64) -> Result<bool, Error> {
        self.change(id, &Step::Remove)
    }

    fn set_tag(&self, id: u64, tag: u64) -> Result<bool, Error> {
        self.change(id, &Step::SetTag(tag))
    }

    fn set_payload(&self, id: u64, payload: &[u8]) -> Result<bool, Error> {
        self.check_payload(payload)?;
        self.change(id, &Step::SetPayload(payload))
    }

    fn get(&self, id: u64) -> Result<Option<Point>, Error> {
        self.core.check_readable()?;
        Ok(self.core.points.read().get(id))
    }

    fn payload(&self, id: u64) -> Result<Option<Vec<u8>>, Error> {
        Ok(self.payloads(&[id])?.pop().flatten())
    }

    fn payloads(&self, ids: &[u64]) -> Result<Vec<Option<Vec<u8>>>, Error> {
        self.core.check_readable()?;
        let mut payloads = vec![None; ids.len()];
        let mut missing = Vec::new();
        {
            let writes = self.core.pending_writes.lock();
            let points = self.core.points.read();
            let stored = ids.iter().copied().enumerate();
            let stored: Vec<(usize, u64)> = stored
                .filter(|(_, id)| points.forest.contains(*id))
                .collect();
            // Searches do not wait for the queue, which is long if the server is away.
            drop(points);
            let pending = writes.payloads(stored.iter().map(|(_, id)| *id));
            for (position, id) in stored {
                let payload = pending.get(&id).copied().flatten();
                payloads[position] = payload.map(<[u8]>::to_vec);
                if payloads[position].is_none() {
                    missing.push((id, position));
                }
            }
        }
        if missing.is_empty() {
            return Ok(payloads);
        }
        // The server answers each id once.
        let ids: BTreeSet<u64> = missing.iter().map(|(id, _)| *id).collect();
        let ids = Vec::from_iter(ids);
        let core = Arc::clone(&self.core);
        let answers = wait_for(async move {
            let (index, revision) = core.published.lock().clone();
            let answers = core.link.payloads(&index, revision, &ids).await?;
            Ok(BTreeMap::from_iter(ids.into_iter().zip(answers)))
        })?;
        for (id, position) in missing {
            payloads[position] = answers.get(&id).cloned().flatten();
        }
        Ok(payloads)
    }

    fn scan(&self) -> Result<ScannedPoints<Error>, Error> {
        self.core.check_readable()?;
        Ok(scan(self.core.points.read().forest.snapshot()))
    }

    fn changes(&self, since: ReadRevision) -> Result<Option<Changes>, Error> {
        self.core.check_readable()?;
        Ok(local::changes(self.core.points.read(), since))
    }

    fn clear(&self) -> Result<(), Error> {
        Err(Error::NotInMemory { call: "clear" })
    }
}

/// The step that stores a row without a payload, under tag 0.
fn plain_put(row: &[f64]) -> Step<'_> {
    Step::Put {
        tag: 0,
        row,
        payload: &[],
    }
}

impl Drop for SharedIndex {
    fn drop(&mut self) {
        if self.core.is_forked() {
            return;
        }
        self.tasks.iter().for_each(AbortHandle::abort);
        let writes = self.core.pending_writes.lock();
        let (pending, unsent) = (writes.written - writes.resolved, writes.unsent.len());
        // The tasks may wait for this lock, and the logger of the caller may take long.
        drop(writes);
        if pending > 0 || unsent > 0 {
            let index = self.core.published.lock().0.name.clone();
            tracing::warn!(
                index,
                pending,
                unsent,
                "dropped with writes that the server has not acknowledged"
            );
        }
    }
}
