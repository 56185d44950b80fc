//! One index of the store: the state of its log.

mod reading;
mod writing;

use std::{
    sync::{Arc, OnceLock, Weak},
    time::SystemTime,
};

use parking_lot::{Mutex, MutexGuard};
use tokio::sync::watch;

use super::{
    layout::{Head, Number, Sum},
    store::Store,
    sync_marks::Mark,
    view::PointsView,
};
use crate::log::{
    Entry, LogError, Operation, Origin, Record, RecordPosition, Retention, Sessions, Window,
    following,
    record::time_ms,
    retention::{BoundedQueue, arrival_ms},
    unapplied::UnappliedQueue,
};

pub(super) struct Index {
    pub(super) entry: Entry,
    pub(super) number: Number,
    name: Arc<str>,
    /// The newest revision that is known to be on disk, or the error that forbids reading and writing. The error is set under
    /// the lock of `state`.
    durable: watch::Sender<Result<u64, LogError>>,
    /// Lock it after `state`, and only briefly.
    unapplied: Mutex<UnappliedQueue<Arc<PointsView>>>,
    /// The holder of this lock may write, and sees the store at this head.
    state: Mutex<State>,
    /// The last known window of kept records. Lock it after `state`.
    window: Mutex<Window>,
}

pub(super) struct State {
    pub(super) head: Head,
    /// The times from which the records after `head.trimmed` count.
    records: BoundedQueue<u64>,
    /// The revisions of the kept operations.
    operations: BoundedQueue<u64>,
    pub(super) sessions: Sessions,
    /// The revisions of forgotten operations that are still in the store.
    forgotten: Vec<u64>,
    /// The records up to this revision are removed from the store.
    pub(super) removed: u64,

    /// False until the stored points were compared with their sum.
    is_checked: bool,
    /// The view of the head, while it is held.
    view: Weak<PointsView>,
}

impl State {
    /// The state of an index that begins at `origin`, with points of this sum.
    pub(super) fn new(origin: Origin, sum: Sum) -> Self {
        Self {
            head: Head::at(&origin, sum),
            records: BoundedQueue::default(),
            operations: BoundedQueue::default(),
            sessions: Sessions::default(),
            forgotten: Vec::new(),
            removed: origin.revision,
            is_checked: true,
            view: Weak::new(),
        }
    }

    /// The state that recovery begins with.
    pub(super) fn unchecked() -> Self {
        Self {
            is_checked: false,
            ..Self::new(Origin::START, Sum::default())
        }
    }

    /// Counts a record that was stored before the store was opened. Its arrival is not stored, so its stamp counts.
    pub(super) fn count_record(&mut self, record: &Record) {
        let time = record.time_ms().min(time_ms(SystemTime::now()));
        self.records.push(time, record.effects().bytes());
    }

    /// Counts a record that arrives now.
    pub(super) fn count_arrival(&mut self, record: &Record) {
        self.records
            .push(arrival_ms(record), record.effects().bytes());
    }

    /// Counts a stored operation.
    pub(super) fn count_operation(&mut self, revision: u64, operation: &Operation) {
        self.operations.push(revision, operation.bytes());
    }
}

impl Index {
    pub(super) fn new(number: Number, entry: Entry, state: State) -> Arc<Self> {
        Arc::new(Self {
            name: entry.name.as_str().into(),
            entry,
            number,
            durable: watch::Sender::new(Ok(state.head.revision)),
            unapplied: Mutex::default(),
            state: Mutex::new(state),
            window: Mutex::default(),
        })
    }

    /// The locked state; an error if the index is closed.
    fn lock_open(&self) -> Result<MutexGuard<'_, State>, LogError> {
        let state = self.state.lock();
        self.durable()?;
        Ok(state)
    }

    /// The newest revision that is known to be on disk; an error if the index is closed.
    pub(super) fn durable(&self) -> Result<u64, LogError> {
        self.durable.borrow().clone()
    }

    /// A receiver of [`Index::durable`].
    pub(super) fn watch_durable(&self) -> watch::Receiver<Result<u64, LogError>> {
        self.durable.subscribe()
    }

    /// Notes that `revision` is on disk.
    pub(super) fn set_durable(&self, revision: u64) {
        following::announce(&self.durable, revision);
    }

    /// Sets the state that recovery found. Recovery makes the found state durable before anyone reads it.
    pub(super) fn set_recovered(&self, state: State) {
        self.set_durable(state.head.revision);
        *self.state.lock() = state;
    }

    /// The mark of its head.
    pub(super) fn head_mark(&self) -> Mark {
        self.mark_of(&self.state.lock().head)
    }

    /// The mark of its head; None if the index is closed.
    pub(super) fn mark(&self) -> Option<Mark> {
        Some(self.mark_of(&self.lock_open().ok()?.head))
    }

    /// Closes the index, ends the streams of its records, and returns the mark of its head.
    pub(super) fn close(&self, why: LogError) -> Mark {
        self.close_locked(&mut self.state.lock(), why)
    }

    /// Closes the index, because a copy at the record `copied` takes its place, and returns the mark of its head. It
    /// is refused if the index can be read and `copied` is neither its newest record nor a later one.
    pub(super) fn supersede(&self, copied: RecordPosition) -> Result<Mark, LogError> {
        let mut state = self.state.lock();
        let head = state.head.position();
        let is_older = copied != head && copied.revision <= head.revision;
        if self.durable().is_ok() && is_older {
            let (copied, head) = (copied.revision, head.revision);
            return Err(LogError::fenced(self.entry.uid, copied, head));
        }
        Ok(self.close_locked(&mut state, LogError::Closed))
    }

    fn close_locked(&self, state: &mut State, why: LogError) -> Mark {
        // The sweeper will remove the points in many batches: freeze the view before the first.
        if let Some(view) = std::mem::take(&mut state.view).upgrade()
            && let Ok(handles) = view.store.handles()
        {
            view.freeze(&handles);
        }
        let _ = self.durable.send_replace(Err(why));
        self.mark_of(&state.head)
    }

    fn mark_of(&self, head: &Head) -> Mark {
        Mark {
            uid: self.entry.uid,
            name: Arc::clone(&self.name),
            revision: head.revision,
            digest: head.digest,
            deleted: false,
        }
    }

    /// The view of the head. It reads the current store until the next write freezes it.
    fn view_of_head(&self, store: &Arc<Store>, state: &mut State) -> Arc<PointsView> {
        if let Some(view) = state.view.upgrade() {
            return view;
        }
        let view = Arc::new(PointsView {
            store: Arc::clone(store),
            frozen: OnceLock::new(),
            number: self.number,
            uid: self.entry.uid,
            position: state.head.position(),
            next_id: state.head.next_id,
            sessions: state.sessions.clone(),
        });
        state.view = Arc::downgrade(&view);
        view
    }

    /// The records that are kept. While the store writes, it returns the last known window.
    pub(super) fn window(&self) -> Window {
        if let Some(state) = self.state.try_lock() {
            *self.window.lock() = state.records.window();
        }
        *self.window.lock()
    }

    /// Forgets the oldest records and operations. The next write of a record removes them from the store. While the
    /// store writes, nothing is forgotten: the caller may be a thread that answers calls, and the next trim catches up.
    pub(super) fn trim(&self, retention: &Retention) -> Result<(), LogError> {
        let Some(mut state) = self.state.try_lock() else {
            return Ok(());
        };
        self.durable()?;
        let state = &mut *state;
        let forgotten = retention.forget_records(&mut state.records, |time| *time);
        state.head.trimmed += forgotten.count() as u64;
        let forgotten = retention.forget_operations(&mut state.operations);
        state.forgotten.extend(forgotten);
        Ok(())
    }
}
