//! The state that a shared index's callers and its two tasks share.

use std::{
    fmt,
    sync::{Arc, OnceLock, Weak},
    time::{Duration, Instant},
};

use parking_lot::{Condvar, Mutex, MutexGuard, RwLock};
use tokio::{sync::Notify, task::block_in_place};
use wayfold_index::Space;

use super::{
    batch::UnsentWrite,
    link::Link,
    meanwhile::{Answerable, MeanwhileAnswers},
    pending::PendingWrites,
    status::ConnectionStatus,
};
use crate::{
    Error, IndexInfo, PayloadEncoding,
    index::{
        local::LocalPoints,
        merger::{self, MergeOwner},
        origin::Origin,
        wait::{deadline, wait_until},
    },
};

/// The order of locks: `pending_writes`, `points`, `published`, `connection`.
pub(in crate::index) struct Core {
    pub(super) space: Space,
    pub(super) link: Link,
    pub(in crate::index) settings: Settings,
    pub(super) pending_writes: Mutex<PendingWrites>,
    /// Wakes callers that wait for `pending_writes`.
    pub(super) progress: Condvar,
    /// Wakes the sender if it waits for writes.
    pub(super) work: Notify,
    /// Wakes the sender if it waits before the next batch.
    pub(super) urgent: Notify,
    /// Wakes the subscriber once the sender has opened a session.
    pub(super) session_opened: Notify,
    pub(super) points: RwLock<LocalPoints>,
    /// The index that the copy follows, and the revision that it has reached. The revision and the number of points in
    /// its description grow stale.
    pub(super) published: Mutex<(Arc<IndexInfo>, u64)>,
    connection: Mutex<Connection>,
    /// The cause for which the index is gone.
    ended: OnceLock<Arc<Error>>,
    /// The process that opened the index.
    origin: Origin,
    this: Weak<Core>,
}

/// The limits of a shared index.
#[derive(Clone, Copy, Debug)]
pub(in crate::index) struct Settings {
    pub(in crate::index) timeout: Duration,
    pub(super) max_pending_bytes: usize,
}

/// The reports of the tasks.
#[derive(Debug, Default)]
struct Connection {
    behind: u64,
    is_reloading: bool,
    /// When and why each task lost its connection, by [`Task`].
    lost: [Option<(Instant, Arc<Error>)>; 2],
}

/// The task that lost its connection.
#[derive(Clone, Copy, Debug)]
pub(super) enum Task {
    Subscriber,
    Sender,
}

impl Core {
    pub(super) fn new(
        link: Link,
        index: Arc<IndexInfo>,
        revision: u64,
        points: LocalPoints,
        mut writes: PendingWrites,
        settings: Settings,
    ) -> Arc<Core> {
        writes.published_points = points.forest.len();
        Arc::new_cyclic(|this| Core {
            space: index.space.clone(),
            link,
            settings,
            pending_writes: Mutex::new(writes),
            progress: Condvar::new(),
            work: Notify::new(),
            urgent: Notify::new(),
            session_opened: Notify::new(),
            points: RwLock::new(points),
            published: Mutex::new((index, revision)),
            connection: Mutex::default(),
            ended: OnceLock::new(),
            origin: Origin::current(),
            this: this.clone(),
        })
    }

    /// True in a process that was forked from the one that opened the index: its threads are not here, and a lock may
    /// be held without end.
    pub(super) fn is_forked(&self) -> bool {
        !self.origin.is_current()
    }

    /// Refuses a read if the index is gone.
    pub(super) fn check_readable(&self) -> Result<(), Error> {
        self.origin.check()?;
        match self.ended.get() {
            Some(why) => Err(Error::Ended {
                why: Arc::clone(why),
            }),
            None => Ok(()),
        }
    }

    /// Waits until writes of `bytes` may be pending, with as many new ids as they need.
    pub(super) fn room(
        &self,
        bytes: usize,
        ids: u64,
    ) -> Result<MutexGuard<'_, PendingWrites>, Error> {
        self.origin.check()?;
        let mut writes = self.pending_writes.lock();
        let mut until = None;
        loop {
            self.check_writable(&writes)?;
            let max_bytes = self.settings.max_pending_bytes;
            let has_room = writes.bytes == 0 || writes.bytes + bytes <= max_bytes;
            if has_room && writes.ids.len() >= ids {
                return Ok(writes);
            }
            writes.requested_ids = writes.requested_ids.max(ids);
            self.wake(&mut writes);
            self.urgent.notify_one();
            let until = *until.get_or_insert_with(|| deadline(self.settings.timeout));
            if !wait_until(&self.progress, &mut writes, until)? {
                return Err(Error::timeout("write", self.settings.timeout));
            }
        }
    }

    /// True if the copy has a point with this id, and takes writes.
    pub(super) fn contains(&self, id: u64) -> Result<bool, Error> {
        self.origin.check()?;
        let writes = self.pending_writes.lock();
        self.check_writable(&writes)?;
        Ok(self.points.read().forest.contains(id))
    }

    /// The most bytes of a payload that the server takes.
    pub(super) fn max_payload_bytes(&self) -> Result<usize, Error> {
        self.origin.check()?;
        Ok(self.pending_writes.lock().limits.max_payload_bytes)
    }

    fn check_writable(&self, writes: &PendingWrites) -> Result<(), Error> {
        self.check_readable()?;
        if writes.is_closed {
            return Err(Error::Closed);
        }
        match &writes.refused {
            Some(why) => Err(Error::WritesRefused {
                why: Arc::clone(why),
            }),
            None => Ok(()),
        }
    }

    /// Wakes the sender if it waits.
    pub(super) fn wake(&self, writes: &mut PendingWrites) {
        if writes.is_idle {
            writes.is_idle = false;
            self.work.notify_one();
        }
    }

    /// Ends a write: merges what is due and wakes the sender.
    pub(super) fn end_write(&self, writes: &mut PendingWrites, points: &mut LocalPoints) {
        self.after_change(points);
        self.wake(writes);
    }

    pub(super) fn after_change(&self, points: &mut LocalPoints) {
        merger::after_change(points, || self.this.clone());
    }

    /// The pending writes; `None` in a forked process.
    fn lock_here(&self) -> Option<MutexGuard<'_, PendingWrites>> {
        (!self.is_forked()).then(|| self.pending_writes.lock())
    }

    /// How the payloads of the index that the copy follows hold edges. A forked process does not take the lock, which may
    /// be held there without end.
    pub(in crate::index) fn payload_encoding(&self) -> PayloadEncoding {
        match self.is_forked() {
            true => PayloadEncoding::Unspecified,
            false => self.published.lock().0.payload_encoding,
        }
    }

    /// The number of writes that the server has not acknowledged.
    pub(in crate::index) fn pending(&self) -> u64 {
        let writes = self.lock_here();
        writes.map_or(0, |writes| writes.written - writes.resolved)
    }

    /// Waits until the server has acknowledged every write before now.
    pub(in crate::index) fn flush(&self, timeout: Duration) -> Result<(), Error> {
        self.origin.check()?;
        let until = deadline(timeout);
        let mut writes = self.pending_writes.lock();
        if let Some(why) = &writes.refused {
            let why = Arc::clone(why);
            return Err(Error::WritesRefused { why });
        }
        let (written, refusals) = (writes.written, writes.refusals);
        while writes.resolved < written {
            self.wake(&mut writes);
            self.urgent.notify_one();
            if !wait_until(&self.progress, &mut writes, until)? {
                return Err(Error::timeout("flush", timeout));
            }
            if writes.refusals > refusals {
                return Err(writes.refusal());
            }
        }
        Ok(())
    }

    /// The server refused a write for good.
    pub(super) fn refuse(&self, writes: &mut PendingWrites, error: Error) {
        let refused = writes.refuse(Arc::new(error), &mut self.points.write());
        debug_assert!(refused.is_ok(), "{refused:?}");
        self.progress.notify_all();
    }

    /// True if the answer to a call on `index` is about the history that the copy follows.
    pub(super) fn is_current(&self, index: &IndexInfo) -> bool {
        self.published.lock().0.uid() == index.uid()
    }

    /// Computes the answers to searches, and keeps them for the caller. Called without a lock.
    pub(super) fn answer(&self, searches: Vec<Answerable>) {
        for answerable in searches {
            let compute = || {
                for answer in answerable.answers(&self.space) {
                    self.pending_writes.lock().open_searches.add(answer);
                }
            };
            match answerable.is_long() {
                true => block_in_place(compute),
                false => compute(),
            }
            self.progress.notify_all();
        }
    }

    /// Takes the answers to searches.
    pub(in crate::index) fn meanwhile(&self) -> MeanwhileAnswers {
        let writes = self.lock_here();
        writes.map_or_else(Default::default, |mut it| it.open_searches.take())
    }

    /// Takes the answers to searches; waits for one if none is here and one is under way.
    pub(in crate::index) fn wait_meanwhile(&self, timeout: Duration) -> MeanwhileAnswers {
        let until = deadline(timeout);
        let Some(mut writes) = self.lock_here() else {
            return MeanwhileAnswers::default();
        };
        while writes.open_searches.are_awaited() && !self.has_ended() {
            self.wake(&mut writes);
            self.urgent.notify_one();
            match wait_until(&self.progress, &mut writes, until) {
                Ok(true) => {}
                Ok(false) => break,
                Err(_) => return writes.open_searches.no_answers(),
            }
        }
        writes.open_searches.take()
    }

    /// Gives back the writes that the server did not take, after which writing begins again.
    pub(in crate::index) fn take_unsent(&self) -> Vec<UnsentWrite> {
        let Some(mut writes) = self.lock_here() else {
            return Vec::new();
        };
        let unsent = writes.take_unsent();
        self.wake(&mut writes);
        unsent
    }

    /// Takes no more writes, waits for the pending ones, and gives back those that the server did not take in time.
    pub(in crate::index) fn close(&self, timeout: Duration) -> Vec<UnsentWrite> {
        match self.lock_here() {
            Some(mut writes) => writes.is_closed = true,
            None => return Vec::new(),
        }
        self.progress.notify_all();
        let flushed = self.flush(timeout);
        let mut writes = self.pending_writes.lock();
        match flushed {
            // The writes stay pending, and the next call waits for them.
            Err(Error::Interrupted) => return Vec::new(),
            Err(_) if writes.resolved < writes.written => self.refuse(&mut writes, Error::Closed),
            _ => {}
        }
        writes.take_unsent()
    }

    pub(super) fn set_following(&self, behind: u64) {
        let mut connection = self.connection.lock();
        connection.behind = behind;
        connection.is_reloading = false;
        connection.lost[Task::Subscriber as usize] = None;
    }

    pub(super) fn set_reloading(&self) {
        let mut connection = self.connection.lock();
        connection.is_reloading = true;
        connection.lost[Task::Subscriber as usize] = None;
    }

    pub(super) fn set_sending(&self) {
        self.connection.lock().lost[Task::Sender as usize] = None;
    }

    pub(super) fn set_disconnected(&self, task: Task, error: Error) {
        let lost = &mut self.connection.lock().lost[task as usize];
        let since = lost.take().map_or_else(Instant::now, |(since, _)| since);
        *lost = Some((since, Arc::new(error)));
    }

    /// The index is gone: nothing will be read or written any more, and no search gets a further answer.
    pub(super) fn end(&self, error: Error) {
        let why = Arc::clone(self.ended.get_or_init(|| Arc::new(error)));
        let mut writes = self.pending_writes.lock();
        self.refuse(&mut writes, Error::Ended { why });
        writes.open_searches.close(usize::MAX);
    }

    pub(super) fn has_ended(&self) -> bool {
        self.ended.get().is_some()
    }

    pub(in crate::index) fn status(&self) -> ConnectionStatus {
        if self.is_forked() {
            let why = Arc::new(Error::Forked);
            return ConnectionStatus::Ended { why };
        }
        let writes = self.pending_writes.lock();
        let connection = self.connection.lock();
        if writes.is_closed {
            return ConnectionStatus::Closed;
        }
        if let Some(why) = self.ended.get() {
            return ConnectionStatus::Ended {
                why: Arc::clone(why),
            };
        }
        if let Some(why) = &writes.refused {
            return ConnectionStatus::Refused {
                why: Arc::clone(why),
            };
        }
        match connection.lost.iter().flatten().next() {
            Some((since, why)) => ConnectionStatus::Disconnected {
                since: *since,
                why: Arc::clone(why),
            },
            None if connection.is_reloading => ConnectionStatus::Reloading,
            None => ConnectionStatus::Following {
                behind: connection.behind,
            },
        }
    }
}

impl fmt::Debug for Core {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Core")
            .field("status", &self.status())
            .finish_non_exhaustive()
    }
}

impl MergeOwner for Core {
    fn with_points(&self, change: &mut dyn FnMut(&mut LocalPoints)) {
        change(&mut self.points.write());
    }
}
