//! The state that a shared index's callers and its two tasks share.

use std::{
    process,
    sync::{Arc, OnceLock, Weak},
    time::{Duration, Instant},
};

use parking_lot::{Condvar, Mutex, MutexGuard, RwLock};
use tokio::sync::Notify;
use wayfold_index::Space;

use super::{batch::UnsentWrite, link::Link, status::Status, writer::Writer};
use crate::{
    Error, IndexHandle,
    index::{
        local::LocalPoints,
        merger::{self, Merged},
    },
};

/// Ids are asked for when fewer than this are left.
const MIN_IDS: u64 = 1 << 15;

/// The ids that are asked for at once.
pub(super) const ID_BLOCK: u64 = 1 << 16;

/// Locks are taken in the order of the fields.
#[derive(Debug)]
pub(super) struct Core {
    pub(super) space: Space,
    pub(super) link: Link,
    pub(super) timeout: Duration,
    pub(super) max_pending_bytes: usize,
    pub(super) writer: Mutex<Writer>,
    /// Wakes callers that wait for `writer`.
    pub(super) progress: Condvar,
    /// Wakes the sender.
    pub(super) work: Notify,
    pub(super) points: RwLock<LocalPoints>,
    /// The revision that the copy has reached, of the uid of the handle.
    pub(super) published: Mutex<(IndexHandle, u64)>,
    connection: Mutex<Connection>,
    /// The cause for which the index is gone.
    ended: OnceLock<Arc<Error>>,
    /// The process that opened the index.
    process: u32,
    this: Weak<Core>,
}

/// What the tasks say of their connection.
#[derive(Debug, Default)]
struct Connection {
    behind: u64,
    is_reloading: bool,
    lost: Option<(Instant, Arc<Error>)>,
}

impl Core {
    pub(super) fn new(
        link: Link,
        index: IndexHandle,
        revision: u64,
        points: LocalPoints,
        writer: Writer,
        timeout: Duration,
        max_pending_bytes: usize,
    ) -> Arc<Core> {
        Arc::new_cyclic(|this| Core {
            space: index.space().clone(),
            link,
            timeout,
            max_pending_bytes,
            writer: Mutex::new(writer),
            progress: Condvar::new(),
            work: Notify::new(),
            points: RwLock::new(points),
            published: Mutex::new((index, revision)),
            connection: Mutex::default(),
            ended: OnceLock::new(),
            process: process::id(),
            this: this.clone(),
        })
    }

    /// Refuses a call in a process that was forked from the one that opened the index.
    fn check(&self) -> Result<(), Error> {
        match process::id() == self.process {
            true => Ok(()),
            false => Err(Error::Forked),
        }
    }

    /// Refuses a read if the index is gone.
    pub(super) fn check_readable(&self) -> Result<(), Error> {
        self.check()?;
        match self.ended.get() {
            Some(why) => Err(Error::Ended {
                why: Arc::clone(why),
            }),
            None => Ok(()),
        }
    }

    /// Waits until a write of `bytes` may be pending, with a new id if it `needs_id`.
    pub(super) fn room(
        &self,
        bytes: usize,
        needs_id: bool,
    ) -> Result<MutexGuard<'_, Writer>, Error> {
        self.check()?;
        let mut writer = self.writer.lock();
        let mut until = None;
        loop {
            if writer.is_closed {
                return Err(Error::Closed);
            }
            if let Some(why) = &writer.refused {
                return Err(Error::WritesRefused {
                    why: Arc::clone(why),
                });
            }
            let has_room = writer.bytes == 0 || writer.bytes + bytes <= self.max_pending_bytes;
            let left = if needs_id { writer.ids.len() } else { 1 };
            if has_room && left > 0 {
                return Ok(writer);
            }
            self.wake(&mut writer);
            let until = *until.get_or_insert_with(|| Instant::now() + self.timeout);
            if self.progress.wait_until(&mut writer, until).timed_out() {
                return Err(Error::timeout("write", self.timeout));
            }
        }
    }

    /// Wakes the sender if it waits.
    pub(super) fn wake(&self, writer: &mut Writer) {
        if writer.is_idle {
            writer.is_idle = false;
            self.work.notify_one();
        }
    }

    /// Ends a write: merges what is due and wakes the sender.
    pub(super) fn written(&self, writer: &mut Writer, points: &mut LocalPoints) {
        self.after_change(points);
        self.wake(writer);
    }

    pub(super) fn after_change(&self, points: &mut LocalPoints) {
        merger::after_change(points, || self.this.clone());
    }

    /// Waits until the server has acknowledged every write before now.
    pub(super) fn flush(&self, timeout: Duration) -> Result<(), Error> {
        self.check()?;
        let until = Instant::now() + timeout;
        let mut writer = self.writer.lock();
        let written = writer.written;
        while writer.settled < written {
            self.wake(&mut writer);
            if self.progress.wait_until(&mut writer, until).timed_out() {
                return Err(Error::timeout("flush", timeout));
            }
        }
        match &writer.refused {
            Some(why) => Err(Error::WritesRefused {
                why: Arc::clone(why),
            }),
            None => Ok(()),
        }
    }

    /// The number of ids to reserve now.
    pub(super) fn wanted_ids(writer: &Writer) -> u64 {
        if writer.ids.len() < MIN_IDS {
            ID_BLOCK
        } else {
            0
        }
    }

    /// The server refused a write for good.
    pub(super) fn refuse(&self, error: Error) {
        self.refuse_if(error, |_| true);
    }

    /// Refuses what is pending for good, if `applies` to the writer.
    pub(super) fn refuse_if(&self, error: Error, applies: impl FnOnce(&Writer) -> bool) {
        let mut writer = self.writer.lock();
        if !applies(&writer) {
            return;
        }
        let refused = writer.refuse(Arc::new(error), &mut self.points.write());
        debug_assert!(refused.is_ok(), "{refused:?}");
        self.progress.notify_all();
    }

    /// The index was made again: refuses what is pending, unless the server has refused it already.
    pub(super) fn lose_session(&self, error: Error) {
        self.refuse_if(error, Writer::has_session);
    }

    /// Gives back the writes that the server did not take, after which writing begins again.
    pub(super) fn take_unsent(&self) -> Vec<UnsentWrite> {
        let mut writer = self.writer.lock();
        let unsent = writer.take_unsent();
        self.wake(&mut writer);
        unsent
    }

    /// Takes no more writes, waits for the pending ones, and gives back those that the server did not take in time.
    pub(super) fn close(&self, timeout: Duration) -> Vec<UnsentWrite> {
        self.writer.lock().is_closed = true;
        let flushed = self.flush(timeout);
        if flushed.is_err() {
            self.refuse(Error::Closed);
        }
        self.progress.notify_all();
        self.writer.lock().take_unsent()
    }

    pub(super) fn following(&self, behind: u64) {
        let mut connection = self.connection.lock();
        connection.behind = behind;
        connection.is_reloading = false;
        connection.lost = None;
    }

    pub(super) fn reloading(&self) {
        self.connection.lock().is_reloading = true;
    }

    pub(super) fn disconnected(&self, error: Error) {
        let mut connection = self.connection.lock();
        let since = connection
            .lost
            .take()
            .map_or_else(Instant::now, |(since, _)| since);
        connection.lost = Some((since, Arc::new(error)));
    }

    /// The index is gone: nothing will be read or written any more.
    pub(super) fn end(&self, error: Error) {
        let why = Arc::new(error);
        let _first_counts = self.ended.set(Arc::clone(&why));
        self.refuse(Error::Ended { why });
    }

    pub(super) fn has_ended(&self) -> bool {
        self.ended.get().is_some()
    }

    pub(super) fn status(&self) -> Status {
        let writer = self.writer.lock();
        let connection = self.connection.lock();
        if writer.is_closed {
            return Status::Closed;
        }
        if let Some(why) = self.ended.get() {
            return Status::Ended {
                why: Arc::clone(why),
            };
        }
        if let Some(why) = &writer.refused {
            return Status::Refused {
                why: Arc::clone(why),
            };
        }
        match &connection.lost {
            Some((since, why)) => Status::Disconnected {
                since: *since,
                why: Arc::clone(why),
            },
            None if connection.is_reloading => Status::Reloading,
            None => Status::Following {
                behind: connection.behind,
            },
        }
    }
}

impl Merged for Core {
    fn with_points(&self, change: &mut dyn FnMut(&mut LocalPoints)) {
        change(&mut self.points.write());
    }
}
