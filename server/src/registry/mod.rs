//! The indices of the server by name, each with one writer and many readers.
//!
//! Architecture:
//! - The journal alone feeds a [`Hosted`] index: its apply loop takes the next record, applies it to the point store
//!   and the forest, and publishes the result (`apply`). Merging is the only other change to a forest, and it changes
//!   no answer.
//! - Readers take the [`Published`] state, one frozen revision, and never wait for the writer.
//! - The holder of the [`Writer`] evaluates a mutation against the published state and the records that are not yet
//!   part of it, and submits the effects (`commit`). From then on nothing depends on the caller, so a dropped call
//!   takes effect whole or not at all. If another writer was first, the mutation is evaluated again.
//! - The registry knows no requests and no transport. Of the limits it knows the number of indices, the window of
//!   remembered operations, and whether the bytes of payloads are counted. It takes in nothing that grows it above the
//!   watermarks of memory and disk.

mod apply;
mod commit;
mod error;
mod fitness;
mod hosted;
mod in_flight;
mod index_limit;
mod labels;
mod loading;
mod maintenance;
mod member_revisions;
mod merging;
mod operations;
mod options;
mod payload_sizes;
mod peer_comparison;
mod recent;
mod records;
mod recovery;
mod replace;
mod replay;
mod reseed;
mod restore;
mod settle;
mod stopped;
mod subscribers;
mod usage;
mod writer;

use std::{collections::BTreeMap, ops::Bound, sync::Arc};

use parking_lot::{Mutex, RwLock};
use tokio::sync::{Semaphore, watch};
use tracing::info;
use wayfold_index::Space;
use wayfold_proto::v1::PayloadEncoding;

use crate::{
    log::{Entry, Log, LogError, RunId, Uid},
    watermark::{Usage, Watermarks},
};
pub use commit::CommitOutcome;
pub use error::RegistryError;
use fitness::Fitness;
pub(crate) use fitness::MAX_CUT_OFF_CHECKS;
pub use hosted::{Hosted, Published};
pub use index_limit::IndexLimit;
use labels::Labels;
pub use operations::OperationWindow;
pub use options::RegistryOptions;
use payload_sizes::PayloadSizes;
pub(crate) use peer_comparison::ComparisonFailure;
pub(crate) use reseed::{LeftOut, Seed, reseed};
pub(crate) use restore::AwaitedCopy;
pub use restore::Restore;
pub(crate) use stopped::Stopped;
pub use subscribers::Subscriber;
pub(crate) use usage::UsagePart;
pub use writer::{WriteGuard, Writer};

/// The indices of the server.
pub struct Registry {
    host: Arc<Host>,
    indexes: RwLock<BTreeMap<String, IndexState>>,
    /// Serialises creating, deleting, restoring and recovering indices. Readers do not take it and never wait for the
    /// log.
    change_lock: Mutex<()>,
    /// Notified of every change of `indexes`.
    changed: watch::Sender<()>,
    fitness: Fitness,
}

/// The state of a named index.
#[derive(Clone)]
pub enum IndexState {
    /// An index that is served.
    Hosted(Arc<Hosted>),
    /// An index that was not replayed, and the cause: it is damaged, or takes too much memory. It can be deleted.
    Damaged(Uid, RegistryError),
}

impl IndexState {
    fn uid(&self) -> Uid {
        match self {
            IndexState::Hosted(hosted) => hosted.uid(),
            IndexState::Damaged(uid, _) => *uid,
        }
    }

    pub(crate) fn hosted(&self) -> Result<&Arc<Hosted>, RegistryError> {
        match self {
            IndexState::Hosted(hosted) => Ok(hosted),
            IndexState::Damaged(_, why) => Err(why.clone()),
        }
    }
}

/// The log, the options, the watermarks and the merge slots that all indices share.
struct Host {
    log: Log,
    watermarks: Watermarks,
    options: RegistryOptions,
    /// A permit per merge that may run.
    merges: Semaphore,
    run: RunId,
    labels: Labels,
    /// The names of the indices that are being restored: they count towards the limits.
    restoring: Mutex<Vec<String>>,
    /// The restored indices that wait for another server to take a copy. A restart forgets them.
    uncopied: Mutex<Vec<Uid>>,
}

impl Registry {
    /// The levels of memory and disk now, by name.
    pub(crate) fn levels(&self) -> Vec<(&'static str, Usage)> {
        self.host.watermarks.levels()
    }

    /// The numbers of calls that the watermarks refused so far, by reason.
    pub(crate) fn refused_growth(&self) -> Vec<(&'static str, u64)> {
        self.host.watermarks.refused()
    }

    /// An empty registry over `log`, without watermarks. [`Registry::replay`] fills it.
    pub fn new(log: impl Into<Log>, options: RegistryOptions) -> Self {
        Self::with_watermarks(log, options, Watermarks::default())
    }

    /// An empty registry over `log`, which refuses growth above the watermarks.
    pub fn with_watermarks(
        log: impl Into<Log>,
        options: RegistryOptions,
        watermarks: Watermarks,
    ) -> Self {
        let merges = Semaphore::new(options.merge_threads.max(1));
        Self {
            host: Arc::new(Host {
                log: log.into(),
                watermarks,
                options,
                merges,
                run: *Uid::unique().as_bytes(),
                labels: Labels::default(),
                restoring: Mutex::default(),
                uncopied: Mutex::default(),
            }),
            indexes: RwLock::default(),
            change_lock: Mutex::new(()),
            changed: watch::Sender::new(()),
            fitness: Fitness::default(),
        }
    }

    /// Hosts every index that the log holds. Call it once, before the first call is answered; with an empty log it does
    /// nothing. A damaged index, or one that takes more memory than there is, does not prevent the others:
    /// [`Registry::get`] returns its error.
    pub fn replay(&self) -> Result<(), RegistryError> {
        let entries = self.host.log.catalogue.indexes()?;
        for (done, entry) in entries.iter().enumerate() {
            let state = replay::replay_or_damaged(&self.host, entry);
            self.change(|indexes| indexes.insert(entry.name.clone(), state));
            if (done + 1).is_multiple_of(1000) {
                info!(done = done + 1, of = entries.len(), "replaying");
            }
        }
        self.add_lost();
        info!(indexes = entries.len(), "replayed the log");
        Ok(())
    }

    /// A receiver of every change from now on: an index is created, deleted, restored, damaged or recovered.
    pub fn changes(&self) -> watch::Receiver<()> {
        self.changed.subscribe()
    }

    /// Changes `indexes` and notifies the receivers.
    fn change<T>(&self, change: impl FnOnce(&mut BTreeMap<String, IndexState>) -> T) -> T {
        let changed = change(&mut self.indexes.write());
        self.changed.send_replace(());
        changed
    }

    /// Adds the indices whose data is lost as damaged, unless other indices have their names.
    fn add_lost(&self) {
        for lost in self.host.log.catalogue.lost() {
            let damaged = IndexState::Damaged(lost.uid, RegistryError::Log(lost.why));
            self.change(|indexes| {
                indexes.entry(lost.name).or_insert(damaged);
            });
        }
    }

    /// The index of this name. [`RegistryError::Deleted`] if it does not exist; another error if it cannot be read.
    pub fn get(&self, name: &str) -> Result<Arc<Hosted>, RegistryError> {
        let found = match self.indexes.read().get(name) {
            Some(state) => state.hosted().cloned(),
            None => Err(self.unopened().unwrap_or(RegistryError::Deleted)),
        };
        found.map_err(|why| why.of_copy(self.is_shared()))
    }

    /// The index with this uid, if it is served.
    pub(crate) fn by_uid(&self, uid: Uid) -> Option<Arc<Hosted>> {
        let indexes = self.indexes.read();
        let state = indexes.values().find(|state| state.uid() == uid)?;
        state.hosted().ok().cloned()
    }

    /// The error of a log that has stopped accepting writes.
    pub fn failure(&self) -> Option<RegistryError> {
        self.host.log.points.failure().map(RegistryError::Log)
    }

    /// True if other servers share the journal, and have the points too.
    fn is_shared(&self) -> bool {
        self.host.log.journal.is_shared()
    }

    /// True while the journal cannot be reached: records of others do not arrive.
    pub fn is_cut_off(&self) -> bool {
        !self.host.log.journal.is_reachable()
    }

    /// True if mutations that add points are accepted now: the store has not failed, the journal can be reached, and
    /// memory and disk are below their watermarks.
    pub fn accepts_growth(&self) -> bool {
        self.failure().is_none() && !self.is_cut_off() && self.host.watermarks.check().is_ok()
    }

    pub(super) fn hosted(&self) -> Vec<Arc<Hosted>> {
        let states = self.indexes.read();
        let hosted = states.values().filter_map(|state| state.hosted().ok());
        hosted.cloned().collect()
    }

    /// The error of a log that is not open. Such a log may hold indices that the registry does not know.
    fn unopened(&self) -> Option<RegistryError> {
        let not_open =
            |why: &LogError| matches!(why, LogError::Unopened { .. } | LogError::Shut { .. });
        let why = self.host.log.points.failure().filter(not_open);
        why.map(RegistryError::Log)
    }

    /// Up to `limit` indices with names after `after` (from the first if None), by name. Damaged indices are listed
    /// too. Fails if no index is known and the log is not open.
    pub fn page(
        &self,
        after: Option<&str>,
        limit: usize,
        is_wanted: impl Fn(&str) -> bool,
    ) -> Result<Vec<(String, IndexState)>, RegistryError> {
        let start = after.map_or(Bound::Unbounded, Bound::Excluded);
        let indexes = self.indexes.read();
        if indexes.is_empty()
            && let Some(why) = self.unopened()
        {
            return Err(why.of_copy(self.is_shared()));
        }
        let page = indexes.range::<str, _>((start, Bound::Unbounded));
        let page = page.filter(|(name, _)| is_wanted(name));
        let listed = page.take(limit);
        Ok(listed
            .map(|(name, state)| (name.clone(), state.clone()))
            .collect())
    }

    /// The merges that run now.
    pub(crate) fn merges(&self) -> u64 {
        let most = self.host.options.merge_threads.max(1);
        most.saturating_sub(self.host.merges.available_permits()) as u64
    }

    /// Creates an index, or finds the one of this name with an equal space; the flag is true if it was created.
    /// [`RegistryError::Exists`] if its space differs, or both declare other payload encodings,
    /// [`RegistryError::TooManyIndexes`] if there are as many indices as `limits`
    /// allow. Blocks on the log.
    pub fn create(
        &self,
        name: &str,
        space: Space,
        payload_encoding: PayloadEncoding,
        limits: &[IndexLimit],
    ) -> Result<(Arc<Hosted>, bool), RegistryError> {
        let _change = self.change_lock.lock();
        if let Some(hosted) = self.find(name, &space, payload_encoding)? {
            return Ok((hosted, false));
        }
        let entry = Entry {
            uid: Uid::unique(),
            name: name.into(),
            space,
            payload_encoding,
        };
        self.check_limits(limits)?;
        self.host.watermarks.admit(0)?;
        match self.host.log.catalogue.create(entry.clone()) {
            Err(LogError::NameTaken { .. }) => {
                self.adopt_changes()?;
                let found = self.find(name, &entry.space, payload_encoding)?;
                // Another server may have deleted it again.
                return found.map(|it| (it, false)).ok_or(RegistryError::Deleted);
            }
            created => created?,
        }
        let forest = self.host.options.forest(&entry.space);
        let view = self.host.log.points.view(entry.uid)?;
        let sizes = PayloadSizes::new(self.host.options.counts_payloads);
        let hosted = Hosted::new(&self.host, &entry, (forest, sizes), view, Vec::new());
        // Its journal begins here.
        let _ = hosted.oldest_at_start.set(1);
        let state = IndexState::Hosted(Arc::clone(&hosted));
        self.change(|indexes| indexes.insert(entry.name, state));
        info!(index = name, uid = %entry.uid, space = %entry.space, "created an index");
        Ok((hosted, true))
    }

    /// The index of this name, if there is one. [`RegistryError::Exists`] if it has another space, or if both declare other
    /// payload encodings.
    pub(crate) fn find(
        &self,
        name: &str,
        space: &Space,
        payload_encoding: PayloadEncoding,
    ) -> Result<Option<Arc<Hosted>>, RegistryError> {
        let hosted = match self.get(name) {
            Ok(hosted) => hosted,
            Err(RegistryError::Deleted) => return Ok(None),
            Err(damaged) => return Err(damaged),
        };
        if hosted.space() != space {
            return Err(RegistryError::Exists {
                what: "space",
                existing: hosted.space().to_string(),
                requested: space.to_string(),
            });
        }
        let declared = [hosted.payload_encoding(), payload_encoding];
        if declared[0] != declared[1] && !declared.contains(&PayloadEncoding::Unspecified) {
            let [existing, requested] = declared.map(|it| it.as_str_name().into());
            return Err(RegistryError::Exists {
                what: "payload encoding",
                existing,
                requested,
            });
        }
        Ok(Some(hosted))
    }

    /// True if `uid` can no longer become the uid of this name here; false in doubt. `hosted` is the uid that it has.
    pub(crate) fn is_past(&self, name: &str, uid: &str, hosted: Option<Uid>) -> bool {
        self.host.log.catalogue.is_past(name, uid, hosted)
    }

    /// Deletes the index of this name if it has `uid`, or if `uid` is None. Readers keep the snapshots they hold. Calls
    /// that wait for the index, and later writes, get [`RegistryError::Deleted`]. Blocks on the log.
    pub fn delete(&self, name: &str, uid: Option<&str>) -> Result<Uid, RegistryError> {
        let _change = self.change_lock.lock();
        let state = self.indexes.read().get(name).cloned();
        let found = state.as_ref().map(IndexState::uid);
        let other = uid.filter(|uid| found.is_none_or(|found| found.to_string() != *uid));
        if other.is_some_and(|uid| !self.is_past(name, uid, found)) {
            return Err(RegistryError::UnknownUid);
        }
        let found = found.ok_or(RegistryError::Deleted)?;
        if other.is_some() {
            return Err(RegistryError::OtherUid { found });
        }
        let deleted = self.host.log.catalogue.delete(found);
        deleted.map_err(|why| RegistryError::from(why).of_copy(self.is_shared()))?;
        self.change(|indexes| indexes.remove(name));
        if let Some(IndexState::Hosted(hosted)) = state {
            hosted.close(RegistryError::Deleted);
        }
        info!(index = name, uid = %found, "deleted an index");
        Ok(found)
    }
}
