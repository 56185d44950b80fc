//! One index: the state that its readers see, and access to its writer.

use std::{
    collections::VecDeque,
    sync::{Arc, atomic::AtomicU64},
    time::SystemTime,
};

use futures_util::FutureExt;
use tokio::sync::{Mutex, watch};
use tracing::{debug, warn};
use wayfold_index::{Snapshot, Space};

use super::{
    Host, OperationWindow, RegistryError, WriteGuard, Writer, merging::FinishedMerge,
    recent::RecentRecords,
};
use crate::log::{Effects, Entry, Keep, LogError, Record, Uid, View};

/// A mutation above these sizes, or one that changes existing points, is committed on a blocking thread. Inline it would
/// delay the calls that share the caller's thread.
const MAX_INLINE_POINTS: usize = 1024;
const MAX_INLINE_BYTES: usize = 128 * 1024;

/// One frozen revision of an index. It does not change while it is held.
pub struct Published {
    /// The points, for search.
    pub snapshot: Snapshot,
    /// The same points in the log, with payloads.
    pub view: Arc<dyn View>,
    /// The revision of both.
    pub revision: u64,
}

/// One index.
pub struct Hosted {
    name: String,
    uid: Uid,
    uid_text: String,
    space: Space,
    pub(super) host: Arc<Host>,
    state: watch::Sender<State>,
    writer: Arc<Mutex<Writer>>,
    /// Merges that wait to be swapped in.
    pub(super) finished_merges: parking_lot::Mutex<Vec<FinishedMerge>>,
    /// The head's revision at the last check for idleness, and at the last check that found the index idle.
    pub(super) last_seen_revision: AtomicU64,
    pub(super) last_idle_revision: AtomicU64,
    unsynced: parking_lot::Mutex<Unsynced>,
    recent: parking_lot::Mutex<RecentRecords>,
}

/// Heads that are not yet as durable as configured, and so not published.
#[derive(Default)]
struct Unsynced {
    /// Oldest first.
    heads: VecDeque<Arc<Published>>,
    /// True if a task publishes them.
    publishing: bool,
}

struct State {
    /// The writer's head, with all finished merges.
    head: Arc<Published>,
    /// The newest revision that is as durable as configured.
    published: Arc<Published>,
    /// The error that closed the index; no later state comes.
    closed: Option<RegistryError>,
}

impl Hosted {
    pub(super) fn new(host: &Arc<Host>, entry: &Entry, writer: Writer) -> Arc<Self> {
        let state = State {
            head: Arc::clone(writer.head()),
            published: Arc::clone(writer.head()),
            closed: None,
        };
        Arc::new(Self {
            name: entry.name.clone(),
            uid: entry.uid,
            uid_text: entry.uid.to_string(),
            space: entry.space.clone(),
            host: Arc::clone(host),
            state: watch::Sender::new(state),
            writer: Arc::new(Mutex::new(writer)),
            finished_merges: parking_lot::Mutex::default(),
            last_seen_revision: AtomicU64::new(u64::MAX),
            last_idle_revision: AtomicU64::new(u64::MAX),
            unsynced: parking_lot::Mutex::default(),
            recent: parking_lot::Mutex::new(RecentRecords::new(host.options.window_bytes)),
        })
    }

    /// Its name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its uid.
    pub fn uid(&self) -> Uid {
        self.uid
    }

    /// Its uid as text.
    pub fn uid_text(&self) -> &str {
        &self.uid_text
    }

    /// Its space.
    pub fn space(&self) -> &Space {
        &self.space
    }

    /// The state that readers see.
    pub fn published(&self) -> Arc<Published> {
        Arc::clone(&self.state.borrow().published)
    }

    /// The writer's head, which readers may not see yet.
    pub fn newest(&self) -> Arc<Published> {
        Arc::clone(&self.state.borrow().head)
    }

    /// Waits until `revision` or a later one is published.
    pub async fn reached(&self, revision: u64) -> Result<Arc<Published>, RegistryError> {
        let published = self.published();
        if published.revision >= revision {
            return Ok(published);
        }
        let mut state = self.state.subscribe();
        let seen = state
            .wait_for(|state| state.published.revision >= revision || state.closed.is_some())
            .await
            .map_err(|_| RegistryError::Deleted)?;
        match &seen.closed {
            Some(why) if seen.published.revision < revision => Err(why.clone()),
            _ => Ok(Arc::clone(&seen.published)),
        }
    }

    /// The published mutations after the revision `after`: the first ones that fit into `max_bytes` (see
    /// [`Effects::bytes`]), but at least one if there is any. [`LogError::Trimmed`] if the log no longer holds them.
    pub async fn mutations(
        self: &Arc<Self>,
        after: u64,
        max_bytes: usize,
    ) -> Result<Vec<Arc<Record>>, RegistryError> {
        let last = self.published().revision;
        if let Some(records) = self.recent.lock().after(after, last, max_bytes) {
            return Ok(records);
        }
        let hosted = Arc::clone(self);
        let read = move || hosted.host.log.tail(hosted.uid, Some(after), max_bytes);
        let read = tokio::task::spawn_blocking(read).await;
        let mut records = read.map_err(|_| RegistryError::Stopped)??;
        records.retain(|record| record.revision() <= last);
        Ok(records)
    }

    /// The records after `revision` up to the head of `writer`, this index's writer; None if some are not cached.
    pub fn records_since(&self, revision: u64, writer: &Writer) -> Option<Vec<Arc<Record>>> {
        let head = writer.head().revision;
        if revision == head {
            return Some(Vec::new());
        }
        self.recent.lock().after(revision, head, usize::MAX)
    }

    /// Waits for the writer, in the order of arrival.
    pub async fn write(&self) -> Result<WriteGuard, RegistryError> {
        let writer = self.write_closed().await;
        match &self.state.borrow().closed {
            Some(why) => Err(why.clone()),
            None => Ok(writer),
        }
    }

    /// Commits a mutation that was evaluated under `writer`: appends the non-empty `effects`, applies them and publishes
    /// them. Returns the new revision once it is as durable as configured. From the first poll on the commit completes,
    /// even if the caller drops the future.
    pub async fn commit(
        self: &Arc<Self>,
        writer: WriteGuard,
        effects: Effects,
        window: OperationWindow,
    ) -> Result<u64, RegistryError> {
        let is_small = effects.len() <= MAX_INLINE_POINTS && effects.bytes() <= MAX_INLINE_BYTES;
        // The log reads a point before it replaces or removes it.
        let next_id = writer.head().view.next_id();
        let is_new = effects.removed().is_empty()
            && effects.stored().iter().all(|point| point.id >= next_id);
        let revision = if is_small && is_new && !self.host.log.is_busy() {
            self.append_and_publish(writer, effects, window)?
        } else {
            let hosted = Arc::clone(self);
            tokio::task::spawn_blocking(move || hosted.append_and_publish(writer, effects, window))
                .await
                .map_err(|_| RegistryError::Stopped)??
        };
        self.reached(revision).await?;
        Ok(revision)
    }

    fn append_and_publish(
        self: &Arc<Self>,
        mut writer: WriteGuard,
        effects: Effects,
        window: OperationWindow,
    ) -> Result<u64, RegistryError> {
        let log = &self.host.log;
        let record = log.append(self.uid, writer.head().revision, effects)?;
        self.swap_in(&mut writer);
        writer.apply(&record, window);
        self.recent.lock().push(record);
        match log.points(self.uid) {
            Ok(view) => writer.advance(view),
            Err(error) => {
                // The log holds the mutation, but no view of it can be published.
                self.close(error.clone().into());
                return Err(error.into());
            }
        }
        self.set_head(writer.head());
        self.start_merging(&mut writer);
        let keep = self.retention(writer.window(), SystemTime::now());
        if let Err(error) = log.trim(self.uid, &keep) {
            warn!(index = self.name, %error, "cannot trim the log");
        }
        let revision = writer.head().revision;
        self.publish_once_synced(writer);
        Ok(revision)
    }

    /// Has the writer's head published once it is synced. One task publishes all heads of an index, and only the newest
    /// head of each sync, so that waiting calls wake once per sync.
    fn publish_once_synced(self: &Arc<Self>, writer: WriteGuard) {
        let mut unsynced = self.unsynced.lock();
        unsynced.heads.push_back(Arc::clone(writer.head()));
        let already_publishing = std::mem::replace(&mut unsynced.publishing, true);
        drop(unsynced);
        // The writer is released only now: otherwise the next head could be queued before this one.
        drop(writer);
        if !already_publishing {
            // Heads that are synced already are published here. A task publishes the rest, since the caller may leave.
            let mut publishing = Box::pin(Arc::clone(self).publish_synced());
            if (&mut publishing).now_or_never().is_none() {
                tokio::spawn(publishing);
            }
        }
    }

    async fn publish_synced(self: Arc<Self>) {
        while let Some(revision) = self.oldest_unsynced() {
            match self.host.log.synced(self.uid, revision).await {
                Ok(synced) => {
                    if let Some(head) = self.take_synced(synced) {
                        self.publish(head);
                    }
                }
                Err(error) => {
                    // The log reports its failure once, so an index logs it at debug level only.
                    debug!(index = self.name, %error, "cannot sync the log");
                    self.close(error.into());
                    *self.unsynced.lock() = Unsynced::default();
                    return;
                }
            }
        }
    }

    /// The revision of the oldest unsynced head. Without one, publishing ends.
    fn oldest_unsynced(&self) -> Option<u64> {
        let mut unsynced = self.unsynced.lock();
        let oldest = unsynced.heads.front().map(|head| head.revision);
        unsynced.publishing = oldest.is_some();
        oldest
    }

    /// Removes the heads up to the revision `synced` and returns the newest of them.
    fn take_synced(&self, synced: u64) -> Option<Arc<Published>> {
        let mut unsynced = self.unsynced.lock();
        let count = unsynced
            .heads
            .partition_point(|head| head.revision <= synced);
        unsynced.heads.drain(..count).next_back()
    }

    /// Publishes `head`, with all merges since if it is still the writer's head, unless a later revision is published.
    fn publish(&self, head: Arc<Published>) {
        self.state.send_if_modified(|state| {
            let newer = head.revision > state.published.revision;
            if newer {
                let same = state.head.revision == head.revision;
                state.published = if same { Arc::clone(&state.head) } else { head };
            }
            newer
        });
    }

    /// Sets the writer's new head, or the same head after a merge. It replaces a published head of the same revision.
    pub(super) fn set_head(&self, head: &Arc<Published>) {
        self.state.send_if_modified(|state| {
            state.head = Arc::clone(head);
            if state.published.revision == head.revision {
                state.published = Arc::clone(head);
            }
            false
        });
    }

    /// The records and operations that the log is to keep.
    fn retention(&self, window: OperationWindow, now: SystemTime) -> Keep {
        let since = now.checked_sub(self.host.options.window);
        Keep {
            record_bytes: self.host.options.window_bytes,
            since: since.unwrap_or(SystemTime::UNIX_EPOCH),
            operations: window.count,
            operation_bytes: window.bytes,
        }
    }

    /// Trims records that are too old. Every commit trims too, so a busy writer is skipped.
    pub(super) fn trim(&self, now: SystemTime) -> Result<(), LogError> {
        match self.writer.try_lock() {
            Ok(writer) => self
                .host
                .log
                .trim(self.uid, &self.retention(writer.window(), now)),
            Err(_) => Ok(()),
        }
    }

    /// Resumes after the log was reopened, if the stored points `view` are at the writer's head; then the head is durable.
    /// Returns false otherwise. Blocks.
    pub(super) fn resume(&self, view: Arc<dyn View>) -> bool {
        let mut writer = Arc::clone(&self.writer).blocking_lock_owned();
        if !writer.is_at(view.revision()) {
            return false;
        }
        writer.advance(view);
        let head = Arc::clone(writer.head());
        self.state.send_modify(|state| {
            state.head = Arc::clone(&head);
            state.published = head;
            state.closed = None;
        });
        true
    }

    /// Closes the index: later writes, and calls that wait for it, get `why`.
    pub(super) fn close(&self, why: RegistryError) {
        self.state.send_modify(|state| state.closed = Some(why));
    }

    /// Waits for the writer, also if the index is closed.
    pub(super) async fn write_closed(&self) -> WriteGuard {
        Arc::clone(&self.writer).lock_owned().await.into()
    }
}
