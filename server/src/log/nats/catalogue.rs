//! The catalogue in NATS: a bucket with a key for each name that an index ever had. A key is changed by
//! compare-and-set, so of two servers that create an index of one name one wins.
//!
//! The bucket keeps the names and uids of deleted indices. A server deletes an index of its point store only if the bucket
//! names it as deleted, or if another index has the name that it claimed for this one. It keeps any other index that the
//! bucket does not name, and does not serve it.

mod bucket;
mod missing_uids;
mod value;

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
    time::Duration,
};

use parking_lot::Mutex;
use tokio::{
    runtime::Handle,
    sync::{Semaphore, watch},
    time::{Instant, sleep_until},
};
use tokio_util::task::AbortOnDropHandle;
use tracing::warn;

use self::{
    bucket::{Bucket, COMPARE_INTERVAL},
    missing_uids::MissingUids,
    value::{CatalogueValue, newest},
};
use super::{NatsError, connection::Connection};
use crate::log::{Catalogue, Entry, LogError, LostIndex, MAX_NAME_BYTES, Uid};

/// The time for which the bucket's leader does not name an index that counts as gone.
const MISSING_TIME: Duration = COMPARE_INTERVAL.saturating_mul(2);

/// The time after which the other servers have heard that an index was deleted.
const PURGE_PAUSE: Duration = Duration::from_secs(30);

/// The attempts to change an entry that other servers change too.
const MAX_ATTEMPTS: usize = 10;

/// See the module.
pub(super) struct NatsCatalogue {
    connection: Arc<Connection>,
    bucket: Arc<Bucket>,
    runtime: Handle,
    /// The indices of this server's point store.
    local: Arc<dyn Catalogue>,
    /// The uids of restored indices whose claims got no answer, by name: NATS may have taken such a claim, and may take it
    /// until it has taken another one of the name.
    unanswered: Mutex<BTreeMap<String, Vec<Uid>>>,
    missing: Arc<Mutex<MissingUids>>,
    /// Held while the leader is asked.
    asking: Arc<Semaphore>,
    _watching: AbortOnDropHandle<()>,
}

impl NatsCatalogue {
    /// Opens the bucket, and creates it if it is missing.
    pub(super) async fn open(
        connection: Arc<Connection>,
        runtime: Handle,
        local: Arc<dyn Catalogue>,
    ) -> Result<Self, NatsError> {
        let bucket = Arc::new(Bucket::open(Arc::clone(&connection)).await?);
        let watched = Arc::clone(&bucket);
        let watching = runtime.spawn(async move {
            tokio::join!(watched.follow(), watched.keep());
        });
        Ok(Self {
            connection,
            bucket,
            runtime,
            local,
            unanswered: Mutex::default(),
            missing: Arc::default(),
            asking: Arc::new(Semaphore::new(1)),
            _watching: AbortOnDropHandle::new(watching),
        })
    }

    /// The value that names an index and its revision, as far as this server knows.
    fn named(&self, uid: Uid) -> Option<(CatalogueValue, u64)> {
        let known = self.bucket.known();
        known.values().find(|(named, _)| named.is(uid)).cloned()
    }

    /// True if the bucket's leader names the index as deleted, which this server then knows too. Blocks.
    pub(super) fn is_deleted(&self, uid: Uid) -> Result<bool, LogError> {
        let text = uid.to_string();
        let has = |named: &CatalogueValue| named.is(uid) || named.deleted.contains(&text);
        let name = {
            let known = self.bucket.known();
            let mut known = known.iter();
            let found = known.find(|(_, (named, _))| has(named));
            found.map(|(name, _)| name.clone())
        };
        let Some(name) = name else {
            return Ok(false);
        };
        let named = self.runtime.block_on(self.bucket.refresh(&name))?;
        Ok(named.is_some_and(|named| named.deleted.contains(&text)))
    }

    /// Changes an entry, and tries again while other changes come first and it may still be changed.
    fn until_unchanged(
        &self,
        may_change: impl Fn() -> bool,
        change: impl Fn() -> Result<(), LogError>,
    ) -> Result<(), LogError> {
        for _ in 1..MAX_ATTEMPTS {
            match change() {
                Err(LogError::NameTaken { .. }) if may_change() => {}
                changed => return changed,
            }
        }
        change()
    }

    fn claim_once(&self, entry: &Entry, replaced: Option<Uid>) -> Result<(), LogError> {
        let before = self.bucket.known().get(&entry.name).cloned();
        let (mut deleted, revision) = match before {
            // The index that has the name may be newer than the one that is to be replaced.
            Some((named, _)) if !named.is_free(replaced) => {
                return Err(LogError::NameTaken { name: named.name });
            }
            Some((mut named, revision)) => {
                let index = named.index.take();
                named.deleted.extend(index.map(|(uid, _)| uid));
                (named.deleted, revision)
            }
            None => (Vec::new(), 0),
        };
        let replaced = replaced.map(|uid| uid.to_string());
        deleted.extend(replaced.filter(|uid| !deleted.contains(uid)));
        let named = CatalogueValue {
            name: entry.name.clone(),
            index: Some((entry.uid.to_string(), entry.content())),
            deleted: newest(deleted),
            contradicted: None,
        };
        let claimed = self.runtime.block_on(self.bucket.set(named, revision));
        let mut unanswered = self.unanswered.lock();
        match &claimed {
            Ok(()) => {
                let void = unanswered.remove(&entry.name).unwrap_or_default();
                drop(unanswered);
                for uid in void.into_iter().filter(|uid| *uid != entry.uid) {
                    // It may have been removed meanwhile.
                    if let Err(error) = self.delete(uid)
                        && !matches!(error, LogError::UnknownIndex { .. })
                    {
                        warn!(index = entry.name, %uid, %error, "cannot remove an index without a name yet");
                        let mut unanswered = self.unanswered.lock();
                        unanswered.entry(entry.name.clone()).or_default().push(uid);
                    }
                }
            }
            Err(LogError::NameTaken { .. }) => {
                // NATS may have taken one of the claims: that index is in use.
                let known = self.bucket.known();
                let taken = known
                    .get(&entry.name)
                    .and_then(|(named, _)| named.index.as_ref());
                if let Some((taken, uids)) = taken.zip(unanswered.get_mut(&entry.name)) {
                    uids.retain(|uid| uid.to_string() != taken.0);
                }
            }
            Err(_) => {
                // A plain create stores its index after the claim, so it leaves nothing to be removed.
                let is_absent = |stored: Vec<Entry>| stored.iter().all(|it| it.uid != entry.uid);
                if !self.local.indexes().is_ok_and(is_absent) {
                    let uids = unanswered.entry(entry.name.clone()).or_default();
                    uids.push(entry.uid);
                }
            }
        }
        claimed
    }

    /// Forgets what other servers published before they heard that the index was deleted.
    fn purge_again(&self, uid: Uid) {
        let connection = Arc::clone(&self.connection);
        self.runtime.spawn(async move {
            sleep_until(Instant::now() + PURGE_PAUSE).await;
            if let Err(error) = connection.purge(uid).await {
                warn!(%uid, %error, "late records of a deleted index may stay in NATS");
            }
        });
    }

    /// True if the bucket's leader has not named an index for so long that NATS, or the list of the deleted ones, must have
    /// forgotten it: what a server knows and NATS has lost is written again before. The leader is asked for the next call.
    fn is_forgotten(&self, name: &str, uid: Uid) -> bool {
        let asked = (name.to_owned(), uid);
        if let Ok(asking) = Arc::clone(&self.asking).try_acquire_owned() {
            let (bucket, missing) = (Arc::clone(&self.bucket), Arc::clone(&self.missing));
            let asked = asked.clone();
            self.runtime.spawn(async move {
                if let Ok(named) = bucket.refresh(&asked.0).await {
                    let is_named = named.is_some_and(|named| named.is(asked.1));
                    missing.lock().note(asked, is_named);
                }
                drop(asking);
            });
        }
        self.missing.lock().time(&asked) >= MISSING_TIME
    }
}

impl Catalogue for NatsCatalogue {
    /// Creates and deletes indices of the point store, so that it has those of NATS. An index that fails there is
    /// returned all the same: reading its points gives the cause.
    fn indexes(&self) -> Result<Vec<Entry>, LogError> {
        let known = self.bucket.known().clone();
        let local = self.local.indexes()?;
        let mut stored = BTreeSet::new();
        for entry in &local {
            let named = known.get(&entry.name).map(|(named, _)| named);
            let uid = entry.uid.to_string();
            if named.is_some_and(|named| named.deleted.contains(&uid)) {
                // Another server may have published after the purge.
                let purged = self.runtime.block_on(self.connection.purge(entry.uid));
                let deleted = purged.and_then(|()| self.local.delete(entry.uid));
                if let Err(error) = deleted {
                    warn!(index = entry.name, uid, %error, "cannot delete an index that was deleted elsewhere yet");
                }
                continue;
            }
            stored.insert(entry.uid);
            if !named.is_some_and(|named| named.is(entry.uid)) {
                warn!(
                    index = entry.name,
                    uid,
                    "NATS does not know this index, so it is not served; its points stay in the data directory"
                );
            }
        }
        let mut entries = Vec::new();
        for (named, _) in known.values() {
            let Some((uid, content)) = &named.index else {
                continue;
            };
            let of = |uid| Entry::of(uid, named.name.clone(), content);
            let Some(entry) = uid.parse().ok().and_then(of) else {
                warn!(?named, "this version cannot read an index of NATS");
                continue;
            };
            if !stored.contains(&entry.uid)
                && let Err(error) = self.local.create(entry.clone())
            {
                warn!(index = entry.name, uid = %entry.uid, %error, "cannot create an index of another server here");
            }
            entries.push(entry);
        }
        Ok(entries)
    }

    fn lost(&self) -> Vec<LostIndex> {
        self.local.lost()
    }

    fn create(&self, entry: Entry) -> Result<(), LogError> {
        self.claim(&entry, None)?;
        self.local.create(entry)
    }

    fn claim(&self, entry: &Entry, replaced: Option<Uid>) -> Result<(), LogError> {
        let is_free = || {
            let known = self.bucket.known();
            let named = known.get(&entry.name);
            named.is_none_or(|(named, _)| named.is_free(replaced))
        };
        self.until_unchanged(is_free, || self.claim_once(entry, replaced))
    }

    fn delete(&self, uid: Uid) -> Result<(), LogError> {
        let forget = || {
            let Some((mut named, revision)) = self.named(uid) else {
                return Ok(());
            };
            (named.index, named.contradicted) = (None, None);
            named.deleted.push(uid.to_string());
            named.deleted = newest(named.deleted);
            self.runtime.block_on(self.bucket.set(named, revision))
        };
        let is_there = || self.named(uid).is_some();
        if let Err(error) = self.until_unchanged(is_there, forget)
            // Otherwise another server has deleted it.
            && is_there()
        {
            return Err(error);
        }
        if let Err(error) = self.runtime.block_on(self.connection.purge(uid)) {
            warn!(%uid, %error, "the records of a deleted index stay in NATS");
        }
        self.purge_again(uid);
        self.local.delete(uid)
    }

    fn note_contradiction(&self, uid: Uid, revision: u64) -> Result<(), LogError> {
        let note = || match self.named(uid) {
            Some((mut named, at)) if named.contradicted.is_none() => {
                named.contradicted = Some(revision);
                self.runtime.block_on(self.bucket.set(named, at))
            }
            _ => Ok(()),
        };
        self.until_unchanged(|| self.named(uid).is_some(), note)
    }

    fn contradiction(&self, name: &str, uid: Uid) -> Option<u64> {
        let known = self.bucket.known();
        let (named, _) = known.get(name).filter(|(named, _)| named.is(uid))?;
        named.contradicted
    }

    fn is_past(&self, name: &str, uid: &str, hosted: Option<Uid>) -> bool {
        let Ok(uid) = uid.parse() else {
            return true;
        };
        // No index has such a name, and it would be remembered.
        if name.len() > MAX_NAME_BYTES {
            return true;
        }
        let known = self.bucket.known().get(name).cloned();
        let is_past = known.and_then(|(named, _)| named.is_past(uid, hosted));
        is_past.unwrap_or_else(|| self.is_forgotten(name, uid))
    }

    /// The first change is the present state.
    fn changes(&self) -> Option<watch::Receiver<()>> {
        let mut changes = self.bucket.changed.subscribe();
        changes.mark_changed();
        Some(changes)
    }
}
