//! One index of the registry: what its readers see, and the way to its writer.

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
    Host, OperationWindow, RegistryError, WriteGuard, Writer, merging::Ran, recent::Recent,
};
use crate::log::{Effects, Entry, Keep, LogError, Record, Uid, View};

/// A mutation of more points or more bytes than these, or one that changes points that there are, is committed on a thread
/// of its own: it would hold up the calls that share the caller's.
const POINTS_IN_PLACE: usize = 1024;
const BYTES_IN_PLACE: usize = 128 * 1024;

/// One frozen revision of an index, for as long as it is held.
pub struct Published {
    /// The points, for search.
    pub snapshot: Snapshot,
    /// The same points as the log stores them, with payloads.
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
    /// Merges that are to be swapped in.
    pub(super) ran: parking_lot::Mutex<Vec<Ran>>,
    /// The head's revision when it was last looked whether anybody writes, and when nobody did.
    pub(super) looked_at: AtomicU64,
    pub(super) paused_at: AtomicU64,
    unsynced: parking_lot::Mutex<Unsynced>,
    recent: parking_lot::Mutex<Recent>,
}

/// Heads that are not yet as durable as configured.
#[derive(Default)]
struct Unsynced {
    /// The oldest first.
    heads: VecDeque<Arc<Published>>,
    /// Whether somebody sees to it that they are published.
    publishing: bool,
}

struct State {
    /// The writer's head, in its newest form.
    head: Arc<Published>,
    /// The newest revision that is as durable as configured.
    published: Arc<Published>,
    /// Why there will be no other.
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
            ran: parking_lot::Mutex::default(),
            looked_at: AtomicU64::new(u64::MAX),
            paused_at: AtomicU64::new(u64::MAX),
            unsynced: parking_lot::Mutex::default(),
            recent: parking_lot::Mutex::new(Recent::new(host.options.window_bytes)),
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

    /// What readers see now.
    pub fn published(&self) -> Arc<Published> {
        Arc::clone(&self.state.borrow().published)
    }

    /// What the writer is at, which readers may not be shown yet.
    pub fn newest(&self) -> Arc<Published> {
        Arc::clone(&self.state.borrow().head)
    }

    /// Waits until readers see `revision`, or a later one.
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

    /// The mutations after the revision `after` that readers see, the first of them that take `most` bytes (see
    /// [`Effects::bytes`]), but at least one unless there are none. [`LogError::Trimmed`] if they are not held any more.
    pub async fn mutations(
        self: &Arc<Self>,
        after: u64,
        most: usize,
    ) -> Result<Vec<Arc<Record>>, RegistryError> {
        let last = self.published().revision;
        if let Some(records) = self.recent.lock().after(after, last, most) {
            return Ok(records);
        }
        let hosted = Arc::clone(self);
        let read = move || hosted.host.log.tail(hosted.uid, Some(after), most);
        let read = tokio::task::spawn_blocking(read).await;
        let mut records = read.map_err(|_| RegistryError::Stopped)??;
        records.retain(|record| record.revision() <= last);
        Ok(records)
    }

    /// The records after `revision` up to the head of `writer`, the index's own; None if they are not all at hand.
    pub fn records_since(&self, revision: u64, writer: &Writer) -> Option<Vec<Arc<Record>>> {
        let head = writer.head().revision;
        if revision == head {
            return Some(Vec::new());
        }
        self.recent.lock().after(revision, head, usize::MAX)
    }

    /// Waits for the writer; those who wait get it in the order in which they came.
    pub async fn write(&self) -> Result<WriteGuard, RegistryError> {
        let writer = self.write_closed().await;
        match &self.state.borrow().closed {
            Some(why) => Err(why.clone()),
            None => Ok(writer),
        }
    }

    /// Commits a mutation that was evaluated under `writer`: appends `effects`, which are not empty, applies them and
    /// publishes. Returns the revision made once it is as durable as configured. From the first poll on it takes
    /// place, whether or not the caller waits.
    pub async fn commit(
        self: &Arc<Self>,
        writer: WriteGuard,
        effects: Effects,
        window: OperationWindow,
    ) -> Result<u64, RegistryError> {
        let is_small = effects.len() <= POINTS_IN_PLACE && effects.bytes() <= BYTES_IN_PLACE;
        // The log reads a point before it replaces or removes it.
        let next_id = writer.head().view.next_id();
        let is_new = effects.removed().is_empty()
            && effects.stored().iter().all(|point| point.id >= next_id);
        let revision = if is_small && is_new && !self.host.log.is_busy() {
            self.commit_here(writer, effects, window)?
        } else {
            let hosted = Arc::clone(self);
            tokio::task::spawn_blocking(move || hosted.commit_here(writer, effects, window))
                .await
                .map_err(|_| RegistryError::Stopped)??
        };
        self.reached(revision).await?;
        Ok(revision)
    }

    fn commit_here(
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
                // The log has the mutation, and readers can never be shown it.
                self.close(error.clone().into());
                return Err(error.into());
            }
        }
        self.show(writer.head());
        self.start_merging(&mut writer);
        let keep = self.keep(writer.window(), SystemTime::now());
        if let Err(error) = log.trim(self.uid, &keep) {
            warn!(index = self.name, %error, "could not trim the log");
        }
        let revision = writer.head().revision;
        self.publish_once_synced(writer);
        Ok(revision)
    }

    /// Sees to it that the writer's head is published once it is synced. One task does so for all heads of an index, and
    /// publishes only the newest that a sync has reached: those who wait are woken once a sync.
    fn publish_once_synced(self: &Arc<Self>, writer: WriteGuard) {
        let mut unsynced = self.unsynced.lock();
        unsynced.heads.push_back(Arc::clone(writer.head()));
        let others_do = std::mem::replace(&mut unsynced.publishing, true);
        drop(unsynced);
        // Not before: the next head would come to stand before this one, and be taken for the older.
        drop(writer);
        if !others_do {
            // What is synced already is published here; the rest without the caller, who may go away.
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
                    // That the log has failed is told once, by itself, and not by each index.
                    debug!(index = self.name, %error, "the log could not be synced");
                    self.close(error.into());
                    *self.unsynced.lock() = Unsynced::default();
                    return;
                }
            }
        }
    }

    /// The revision of the oldest head that is not synced; with the last of them publishing ends.
    fn oldest_unsynced(&self) -> Option<u64> {
        let mut unsynced = self.unsynced.lock();
        let oldest = unsynced.heads.front().map(|head| head.revision);
        unsynced.publishing = oldest.is_some();
        oldest
    }

    /// Takes the heads up to the revision `synced`; of these the newest is of interest.
    fn take_synced(&self, synced: u64) -> Option<Arc<Published>> {
        let mut unsynced = self.unsynced.lock();
        let count = unsynced
            .heads
            .partition_point(|head| head.revision <= synced);
        unsynced.heads.drain(..count).next_back()
    }

    /// Lets readers see what was the writer's head at `head.revision`, in its newest form, unless they see a later
    /// revision.
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

    /// Takes note of a new head of the writer, or of a new form of the same; readers who see that revision get it.
    pub(super) fn show(&self, head: &Arc<Published>) {
        self.state.send_if_modified(|state| {
            state.head = Arc::clone(head);
            if state.published.revision == head.revision {
                state.published = Arc::clone(head);
            }
            false
        });
    }

    /// What the log is to keep of the past.
    fn keep(&self, window: OperationWindow, now: SystemTime) -> Keep {
        let since = now.checked_sub(self.host.options.window);
        Keep {
            record_bytes: self.host.options.window_bytes,
            since: since.unwrap_or(SystemTime::UNIX_EPOCH),
            operations: window.count,
            operation_bytes: window.bytes,
        }
    }

    /// Forgets records that are too old. What is being written is trimmed by who writes it.
    pub(super) fn trim(&self, now: SystemTime) -> Result<(), LogError> {
        match self.writer.try_lock() {
            Ok(writer) => self
                .host
                .log
                .trim(self.uid, &self.keep(writer.window(), now)),
            Err(_) => Ok(()),
        }
    }

    /// Goes on after the log was opened anew, if `view`, its points as they are stored, is what the writer's head is;
    /// all of it is durable then. It blocks.
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

    /// Ends the index: nothing is written any more.
    pub(super) fn close(&self, why: RegistryError) {
        self.state.send_modify(|state| state.closed = Some(why));
    }

    /// Waits for the writer even of an index that is closed.
    pub(super) async fn write_closed(&self) -> WriteGuard {
        Arc::clone(&self.writer).lock_owned().await.into()
    }
}
