//! The bucket of the catalogue in NATS, and what this server knows of it.
//!
//! NATS may lose what it has acknowledged. What a server knows and the bucket lacks is written again, unless another index
//! has got the name meanwhile.

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use async_nats::jetstream::kv;
use base64::{Engine as _, engine::general_purpose::URL_SAFE_NO_PAD};
use bytes::Bytes;
use futures_util::StreamExt;
use tokio::{
    sync::watch,
    time::{Instant, MissedTickBehavior, interval, timeout},
};
use tracing::{debug, warn};

use super::value::{CatalogueValue, read};
use crate::log::{
    LogError,
    nats::{
        NatsError, RETRY_INTERVAL,
        connection::{Connection, REQUEST_TIMEOUT, found, patiently, unreachable, within},
        settings::check_bucket,
    },
};

/// The time in which a bucket without a leader gets one.
const SET_TIME: Duration = Duration::from_secs(5);

/// The reads of the whole bucket until a start goes on without entries that NATS does not send.
const MAX_READS: usize = 3;

/// The time between two comparisons of the bucket with what is known of it.
pub(super) const COMPARE_INTERVAL: Duration = Duration::from_secs(10);

/// The values by name, each with the revision of its key.
pub(super) type CatalogueValues = BTreeMap<String, (CatalogueValue, u64)>;

/// See the module.
pub(super) struct Bucket {
    connection: Arc<Connection>,
    store: kv::Store,
    known: watch::Sender<CatalogueValues>,
    pub(super) changed: watch::Sender<()>,
}

impl Bucket {
    /// Opens the bucket, and creates it if it is missing.
    pub(super) async fn open(connection: Arc<Connection>) -> Result<Self, NatsError> {
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
        let store = patiently(&what, create).await?;
        check_bucket(&store.stream, &format!("$KV.{}.>", config.bucket))?;
        let (mut known, mut is_complete) = patiently(&what, || read_all(&store)).await?;
        // NATS may only be away for a moment.
        for _ in 1..MAX_READS {
            if is_complete {
                break;
            }
            (known, is_complete) = patiently(&what, || read_all(&store)).await?;
        }
        Ok(Self {
            connection,
            store,
            known: watch::Sender::new(known),
            changed: watch::Sender::new(()),
        })
    }

    /// The values that this server knows.
    pub(super) fn known(&self) -> watch::Ref<'_, CatalogueValues> {
        self.known.borrow()
    }

    /// Sets the key of a name, which has this revision (0 if it does not exist). [`LogError::NameTaken`] if another server
    /// has changed it since. It waits a moment for a bucket without a leader, as at a start of NATS, and sets it again if
    /// NATS has lost what this server knows.
    pub(super) async fn set(&self, named: CatalogueValue, revision: u64) -> Result<(), LogError> {
        let key = key(&named.name);
        let value = Bytes::from(serde_json::to_vec(&named).map_err(unreachable)?);
        let (until, mut attempts) = (Instant::now() + SET_TIME, interval(RETRY_INTERVAL));
        let mut expected = revision;
        let now = loop {
            attempts.tick().await;
            let update = self.store.update(&key, value.clone(), expected);
            let error = match within(async { update.await.map_err(unreachable) }).await {
                Ok(now) => break now,
                Err(error) => error,
            };
            // Another server was first, or the answer was lost. A repetition takes effect once: it expects the revision.
            match self.newest(&named.name).await {
                Ok(Some((found, now))) if found == named => break now,
                Ok(Some((found, now))) if !named.follows(&found) => {
                    self.note(found, now, Some(revision));
                    return Err(LogError::NameTaken { name: named.name });
                }
                newest if Instant::now() >= until => return Err(newest.err().unwrap_or(error)),
                Ok(older) => expected = older.map_or(0, |(_, now)| now),
                Err(_) => {}
            }
        };
        self.note(named, now, None);
        Ok(())
    }

    /// Notes a value, unless what is known may have come after it. A NATS that has lost values gives their revisions again, so
    /// the content decides first. The value of the revision `lost` gives way to any that the bucket has instead.
    fn note(&self, named: CatalogueValue, revision: u64, lost: Option<u64>) {
        let is_changed = self.known.send_if_modified(|known| {
            let gives_way = |(before, at): &(CatalogueValue, u64)| match () {
                () if *before == named => revision > *at,
                () if Some(*at) == lost => true,
                () if before.follows(&named) => false,
                () => named.follows(before) || revision > *at,
            };
            if known.get(&named.name).is_some_and(|it| !gives_way(it)) {
                return false;
            }
            known.insert(named.name.clone(), (named, revision));
            true
        });
        if is_changed {
            self.changed.send_replace(());
        }
    }

    /// The value of a name and its revision, of the bucket's leader.
    async fn newest(&self, name: &str) -> Result<Option<(CatalogueValue, u64)>, LogError> {
        let subject = format!("$KV.{}.{}", self.connection.catalogue_name(), key(name));
        let last = self.store.stream.get_last_raw_message_by_subject(&subject);
        let last = within(async { found(last.await) }).await?;
        Ok(last.and_then(|message| Some((read(&message.payload)?, message.sequence))))
    }

    /// The value of a name at the bucket's leader, which is noted.
    pub(super) async fn refresh(&self, name: &str) -> Result<Option<CatalogueValue>, LogError> {
        let newest = self.newest(name).await?;
        Ok(newest.map(|(named, revision)| {
            self.note(named.clone(), revision, None);
            named
        }))
    }

    /// Notes every change of the bucket.
    pub(super) async fn follow(&self) {
        let mut attempts = interval(RETRY_INTERVAL);
        attempts.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            attempts.tick().await;
            // From the first revision on: what changed while there was no connection comes again.
            if let Ok(mut entries) = self.store.watch_all_from_revision(1).await {
                while let Some(Ok(entry)) = entries.next().await {
                    if let Some(named) = read(&entry.value) {
                        self.note(named, entry.revision, None);
                    }
                }
            }
            debug!("the catalogue in NATS cannot be followed now");
        }
    }

    /// Writes again what the bucket has lost.
    pub(super) async fn keep(&self) {
        let mut comparisons = interval(COMPARE_INTERVAL);
        comparisons.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            comparisons.tick().await;
            let Ok(Ok((stored, _))) = timeout(COMPARE_INTERVAL, read_all(&self.store)).await else {
                continue;
            };
            // The watch skips the revisions that it has seen, even in a bucket that was created again.
            for (named, revision) in stored.values() {
                self.note(named.clone(), *revision, None);
            }
            let known = self.known().clone();
            for (name, (named, revision)) in known {
                if stored.get(&name).is_none_or(|(found, _)| *found != named) {
                    self.keep_one(named, revision).await;
                }
            }
        }
    }

    /// Writes a value again if the bucket has lost it.
    async fn keep_one(&self, named: CatalogueValue, revision: u64) {
        // Another copy of the bucket may lag behind its leader.
        match self.newest(&named.name).await {
            Ok(Some((found, _))) if found == named => {}
            Ok(Some((found, at))) if !named.follows(&found) => {
                if !found.follows(&named) {
                    warn!(
                        index = named.name,
                        "another index has a name whose entry NATS had lost"
                    );
                }
                self.note(found, at, Some(revision));
            }
            Ok(_) => {
                warn!(
                    index = named.name,
                    "NATS has lost an entry of the catalogue; writing it again"
                );
                if let Err(error) = self.set(named, revision).await {
                    debug!(%error, "the entry is written again later, or another index has the name");
                }
            }
            Err(error) => debug!(%error, "the catalogue in NATS cannot be compared now"),
        }
    }
}

/// The key of a name: NATS does not allow all characters.
fn key(name: &str) -> String {
    URL_SAFE_NO_PAD.encode(name)
}

/// The present content of a bucket; the flag is false if NATS did not send all of it in time.
async fn read_all(bucket: &kv::Store) -> Result<(CatalogueValues, bool), LogError> {
    let mut values = CatalogueValues::new();
    // `Store::status` returns the count at the open.
    let info = bucket.stream.get_info().await.map_err(unreachable)?;
    if info.state.messages == 0 {
        return Ok((values, true));
    }
    let entries = bucket.watch_all_from_revision(1).await;
    let mut entries = entries.map_err(unreachable)?;
    loop {
        // A replica never sends an entry that it has lost, and counts it as pending.
        let Ok(next) = timeout(REQUEST_TIMEOUT, entries.next()).await else {
            warn!(
                entries = values.len(),
                "NATS does not send all entries of the catalogue"
            );
            return Ok((values, false));
        };
        let Some(entry) = next else {
            return Ok((values, true));
        };
        let entry = entry.map_err(unreachable)?;
        if let Some(named) = read(&entry.value) {
            values.insert(named.name.clone(), (named, entry.revision));
        }
        if entry.seen_current {
            return Ok((values, true));
        }
    }
}
