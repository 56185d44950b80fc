//! The catalogue in NATS: a bucket with a key for each name that an index ever had. A key is changed by
//! compare-and-set, so of two servers that create an index of one name one wins.
//!
//! The bucket keeps the names and uids of deleted indices. A server deletes an index of its point store only if the bucket
//! names it as deleted. It keeps an index that the bucket does not name, and does not serve it.

mod value;

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
    time::Duration,
};

use async_nats::jetstream::kv;
use base64::{Engine as _, engine::general_purpose::URL_SAFE_NO_PAD};
use bytes::Bytes;
use futures_util::StreamExt;
use parking_lot::Mutex;
use tokio::{
    runtime::Handle,
    sync::watch,
    time::{Instant, MissedTickBehavior, interval},
};
use tokio_util::task::AbortOnDropHandle;
use tracing::{debug, warn};

use self::value::{CatalogueValue, newest, read};
use super::{
    NatsError, RETRY_INTERVAL,
    connection::{Connection, found, patiently, unreachable, within},
};
use crate::log::{Catalogue, Entry, LogError, LostIndex, Uid};

/// The attempts to change an entry that other servers change too.
const MAX_ATTEMPTS: usize = 10;

/// The time in which a bucket without a leader gets one.
const SET_TIME: Duration = Duration::from_secs(5);

/// The values by name, each with the revision of its key.
type CatalogueValues = BTreeMap<String, (CatalogueValue, u64)>;

/// See the module.
pub(super) struct NatsCatalogue {
    connection: Arc<Connection>,
    bucket: kv::Store,
    runtime: Handle,
    /// The indices of this server's point store.
    local: Arc<dyn Catalogue>,
    known: Arc<watch::Sender<CatalogueValues>>,
    /// The uids of claims without an answer, by name. None of them is in the bucket once a later claim of the name is.
    unanswered: Mutex<BTreeMap<String, Vec<String>>>,
    changed: watch::Sender<()>,
    _watching: AbortOnDropHandle<()>,
}

impl NatsCatalogue {
    /// Opens the bucket, and creates it if it is missing.
    pub(super) async fn open(
        connection: Arc<Connection>,
        runtime: Handle,
        local: Arc<dyn Catalogue>,
    ) -> Result<Self, NatsError> {
        let config = kv::Config {
            bucket: connection.catalogue_name(),
            description: "the indices of Wayfold".into(),
            history: 1,
            num_replicas: connection.replicas,
            ..kv::Config::default()
        };
        let what = format!("bucket {}", config.bucket);
        let create = || async {
            match connection.context.get_key_value(&config.bucket).await {
                Ok(bucket) => Ok(bucket),
                Err(_) => connection.context.create_key_value(config.clone()).await,
            }
        };
        let bucket = patiently(&what, create).await?;
        let known = patiently(&what, || read_all(&bucket)).await?;
        let known = Arc::new(watch::Sender::new(known));
        let changed = watch::Sender::new(());
        let watching = follow(bucket.clone(), Arc::clone(&known), changed.clone());
        Ok(Self {
            _watching: AbortOnDropHandle::new(runtime.spawn(watching)),
            connection,
            bucket,
            runtime,
            local,
            known,
            unanswered: Mutex::default(),
            changed,
        })
    }

    /// Sets the key of a name, which has this revision (0 if it does not exist). [`LogError::NameTaken`] if another server
    /// has changed it since. It waits a moment for a bucket without a leader, as at a start of NATS, and sets it again if
    /// NATS has lost what this server knows.
    async fn set(&self, named: CatalogueValue, revision: u64) -> Result<(), LogError> {
        let key = key(&named.name);
        let value = Bytes::from(serde_json::to_vec(&named).map_err(unreachable)?);
        let (until, mut attempts) = (Instant::now() + SET_TIME, interval(RETRY_INTERVAL));
        let mut expected = revision;
        let now = loop {
            attempts.tick().await;
            let update = self.bucket.update(&key, value.clone(), expected);
            let error = match within(async { update.await.map_err(unreachable) }).await {
                Ok(now) => break now,
                Err(error) => error,
            };
            // Another server was first, or the answer was lost. A repetition takes effect once: it expects the revision.
            match self.newest(&named.name).await {
                Ok(Some((found, now))) if found == named => break now,
                Ok(Some((found, now))) if now > revision || !named.follows(&found) => {
                    self.note(found, now, revision);
                    return Err(LogError::NameTaken { name: named.name });
                }
                newest if Instant::now() >= until => return Err(newest.err().unwrap_or(error)),
                Ok(older) => expected = older.map_or(0, |(_, now)| now),
                Err(_) => {}
            }
        };
        self.note(named, now, revision);
        Ok(())
    }

    /// Notes what has come after the revision `known`, or in its place if NATS has lost that.
    fn note(&self, named: CatalogueValue, revision: u64, known: u64) {
        if revision <= known {
            self.known
                .send_modify(|known| drop(known.remove(&named.name)));
        }
        note(&self.known, named, revision);
        self.changed.send_replace(());
    }

    /// The value that names an index and its revision, as far as this server knows.
    fn named(&self, uid: Uid) -> Option<(CatalogueValue, u64)> {
        let known = self.known.borrow();
        known.values().find(|(named, _)| named.is(uid)).cloned()
    }

    /// Changes the entry of an index, again as long as other changes come first and it is still there.
    fn until_unchanged(
        &self,
        uid: Option<Uid>,
        change: impl Fn() -> Result<(), LogError>,
    ) -> Result<(), LogError> {
        let is_there = || uid.is_some_and(|uid| self.named(uid).is_some());
        for _ in 1..MAX_ATTEMPTS {
            match change() {
                Err(LogError::NameTaken { .. }) if is_there() => {}
                changed => return changed,
            }
        }
        change()
    }

    fn claim_once(&self, entry: &Entry, replaced: Option<Uid>) -> Result<(), LogError> {
        let before = self.known.borrow().get(&entry.name).cloned();
        let (mut deleted, revision) = match before {
            // The index that has the name may be newer than the one that is to be replaced.
            Some((named, _))
                if named.index.is_some() && !replaced.is_some_and(|it| named.is(it)) =>
            {
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
        let unanswered = self.unanswered.lock().get(&entry.name).cloned();
        deleted.extend(unanswered.unwrap_or_default());
        let named = CatalogueValue {
            name: entry.name.clone(),
            index: Some((entry.uid.to_string(), entry.content())),
            deleted: newest(deleted),
            contradicted: None,
        };
        let claimed = self.runtime.block_on(self.set(named, revision));
        let mut unanswered = self.unanswered.lock();
        match &claimed {
            Ok(()) => drop(unanswered.remove(&entry.name)),
            Err(LogError::NameTaken { .. }) => {}
            Err(_) => {
                let uids = unanswered.entry(entry.name.clone()).or_default();
                uids.push(entry.uid.to_string());
            }
        }
        claimed
    }

    /// The value of a name and its revision, of the bucket's leader.
    async fn newest(&self, name: &str) -> Result<Option<(CatalogueValue, u64)>, LogError> {
        let subject = format!("$KV.{}.{}", self.connection.catalogue_name(), key(name));
        let last = self.bucket.stream.get_last_raw_message_by_subject(&subject);
        let last = within(async { found(last.await) }).await?;
        Ok(last.and_then(|message| Some((read(&message.payload)?, message.sequence))))
    }
}

impl Catalogue for NatsCatalogue {
    /// Creates and deletes indices of the point store, so that it has those of NATS. An index that fails there is
    /// returned all the same: reading its points gives the cause.
    fn indexes(&self) -> Result<Vec<Entry>, LogError> {
        let known = self.known.borrow().clone();
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
        self.until_unchanged(replaced, || self.claim_once(entry, replaced))
    }

    fn delete(&self, uid: Uid) -> Result<(), LogError> {
        let forget = || {
            let Some((mut named, revision)) = self.named(uid) else {
                return Ok(());
            };
            (named.index, named.contradicted) = (None, None);
            named.deleted.push(uid.to_string());
            named.deleted = newest(named.deleted);
            self.runtime.block_on(self.set(named, revision))
        };
        if let Err(error) = self.until_unchanged(Some(uid), forget)
            // Otherwise another server has deleted it.
            && self.named(uid).is_some()
        {
            return Err(error);
        }
        if let Err(error) = self.runtime.block_on(self.connection.purge(uid)) {
            warn!(%uid, %error, "the records of a deleted index stay in NATS");
        }
        self.local.delete(uid)
    }

    fn note_contradiction(&self, uid: Uid, revision: u64) -> Result<(), LogError> {
        let note = || match self.named(uid) {
            Some((mut named, at)) if named.contradicted.is_none() => {
                named.contradicted = Some(revision);
                self.runtime.block_on(self.set(named, at))
            }
            _ => Ok(()),
        };
        self.until_unchanged(Some(uid), note)
    }

    fn contradiction(&self, name: &str, uid: Uid) -> Option<u64> {
        let known = self.known.borrow();
        let (named, _) = known.get(name).filter(|(named, _)| named.is(uid))?;
        named.contradicted
    }

    /// The first change is the present state.
    fn changes(&self) -> Option<watch::Receiver<()>> {
        let mut changes = self.changed.subscribe();
        changes.mark_changed();
        Some(changes)
    }
}

/// The key of a name: NATS does not allow all characters.
fn key(name: &str) -> String {
    URL_SAFE_NO_PAD.encode(name)
}

/// Notes a value unless a newer one is known; true if that changed anything.
fn note(known: &watch::Sender<CatalogueValues>, named: CatalogueValue, revision: u64) -> bool {
    known.send_if_modified(|known| {
        // NATS gives a revision again if it has lost the value that had it.
        let is_older = |(before, at): &(CatalogueValue, u64)| {
            *at >= revision && (*before == named || !named.follows(before))
        };
        if known.get(&named.name).is_some_and(is_older) {
            return false;
        }
        known.insert(named.name.clone(), (named, revision));
        true
    })
}

/// The present content of a bucket.
async fn read_all(bucket: &kv::Store) -> Result<CatalogueValues, LogError> {
    let mut known = CatalogueValues::new();
    if bucket.status().await.map_err(unreachable)?.values() == 0 {
        return Ok(known);
    }
    let entries = bucket.watch_all_from_revision(1).await;
    let mut entries = entries.map_err(unreachable)?;
    while let Some(entry) = entries.next().await {
        let entry = entry.map_err(unreachable)?;
        if let Some(named) = read(&entry.value) {
            known.insert(named.name.clone(), (named, entry.revision));
        }
        if entry.seen_current {
            break;
        }
    }
    Ok(known)
}

/// Notes every change of the bucket.
async fn follow(
    bucket: kv::Store,
    known: Arc<watch::Sender<CatalogueValues>>,
    changed: watch::Sender<()>,
) {
    let mut attempts = interval(RETRY_INTERVAL);
    attempts.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        attempts.tick().await;
        // From the first revision on: what changed while there was no connection comes again.
        if let Ok(mut entries) = bucket.watch_all_from_revision(1).await {
            while let Some(Ok(entry)) = entries.next().await {
                if let Some(named) = read(&entry.value)
                    && note(&known, named, entry.revision)
                {
                    changed.send_replace(());
                }
            }
        }
        debug!("the catalogue in NATS cannot be followed now");
    }
}
