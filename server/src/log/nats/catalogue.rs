//! The catalogue in NATS: a bucket with a key for each name that an index ever had. A key is changed by
//! compare-and-set, so of two servers that create an index of one name one wins.
//!
//! A deleted index leaves its name and uid behind. A server therefore knows of each index of its point store whether it
//! was deleted, or whether NATS has forgotten it: an index of which NATS knows nothing is kept and not served.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use async_nats::jetstream::kv;
use base64::{Engine as _, engine::general_purpose::URL_SAFE_NO_PAD};
use bytes::Bytes;
use futures_util::StreamExt;
use serde::{Deserialize, Serialize};
use tokio::{runtime::Handle, sync::watch, time::interval};
use tokio_util::task::AbortOnDropHandle;
use tracing::{debug, warn};

use super::{
    NatsError, RETRY_INTERVAL,
    connection::{Connection, patiently, unreachable},
};
use crate::log::{Catalogue, Entry, LogError, Lost, Uid};

/// A key's value: the last index of a name.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Named {
    uid: String,
    name: String,
    space: String,
    is_deleted: bool,
}

/// A value and the revision of its key.
type Known = BTreeMap<String, (Named, u64)>;

/// See the module.
pub(super) struct NatsCatalogue {
    connection: Arc<Connection>,
    bucket: kv::Store,
    runtime: Handle,
    /// The indices of this server's point store.
    local: Arc<dyn Catalogue>,
    known: Arc<watch::Sender<Known>>,
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
            changed,
        })
    }

    /// Sets the key of a name, which has this revision (0 if it does not exist).
    async fn set(&self, named: Named, revision: u64) -> Result<(), LogError> {
        let key = key(&named.name);
        let value = serde_json::to_vec(&named).map_err(unreachable)?;
        let set = self.bucket.update(&key, value.into(), revision).await;
        let now = match set {
            Ok(now) => now,
            Err(error) => {
                // Another server was first, or the answer was lost.
                let found = self.bucket.entry(&key).await.map_err(unreachable)?;
                let found = found.and_then(|entry| {
                    let found = serde_json::from_slice::<Named>(&entry.value).ok()?;
                    Some((found, entry.revision))
                });
                match found {
                    Some((found, now)) if found == named => now,
                    Some((found, now)) => {
                        note(&self.known, found, now);
                        return Err(LogError::NameTaken { name: named.name });
                    }
                    None => return Err(unreachable(error)),
                }
            }
        };
        note(&self.known, named, now);
        Ok(())
    }
}

impl Catalogue for NatsCatalogue {
    /// Creates and deletes indices of the point store, so that it has those of NATS.
    fn indexes(&self) -> Result<Vec<Entry>, LogError> {
        let known = self.known.borrow().clone();
        let local = self.local.indexes()?;
        let mut stored: BTreeSet<_> = local.iter().map(|entry| entry.uid).collect();
        for entry in &local {
            match known.get(&entry.name) {
                Some((named, _)) if named.is_deleted || !named.is(entry.uid) => {
                    self.local.delete(entry.uid)?;
                    stored.remove(&entry.uid);
                }
                Some(_) => {}
                None => warn!(
                    index = entry.name,
                    uid = %entry.uid,
                    "NATS does not know this index, so it is not served; its points stay in the data directory"
                ),
            }
        }
        let mut entries = Vec::new();
        for (named, _) in known.values().filter(|(named, _)| !named.is_deleted) {
            let (Ok(uid), Ok(space)) = (named.uid.parse(), named.space.parse()) else {
                warn!(
                    ?named,
                    "this version cannot read an index of the catalogue in NATS"
                );
                continue;
            };
            let entry = Entry {
                uid,
                name: named.name.clone(),
                space,
            };
            if !stored.contains(&entry.uid) {
                self.local.create(entry.clone())?;
            }
            entries.push(entry);
        }
        Ok(entries)
    }

    fn lost(&self) -> Vec<Lost> {
        self.local.lost()
    }

    fn create(&self, entry: Entry) -> Result<(), LogError> {
        let before = self.known.borrow().get(&entry.name).cloned();
        let revision = match before {
            Some((named, _)) if !named.is_deleted => {
                return Err(LogError::NameTaken { name: entry.name });
            }
            Some((_, revision)) => revision,
            None => 0,
        };
        let named = Named {
            uid: entry.uid.to_string(),
            name: entry.name.clone(),
            space: entry.space.to_string(),
            is_deleted: false,
        };
        self.runtime.block_on(self.set(named, revision))?;
        self.local.create(entry)
    }

    fn delete(&self, uid: Uid) -> Result<(), LogError> {
        let known = self.known.borrow().clone();
        let found = known.into_values().find(|(named, _)| named.is(uid));
        if let Some((named, revision)) = found.filter(|(named, _)| !named.is_deleted) {
            let deleted = Named {
                is_deleted: true,
                ..named
            };
            let deleting = async {
                match self.set(deleted, revision).await {
                    // Another server has deleted it.
                    Ok(()) | Err(LogError::NameTaken { .. }) => {}
                    Err(error) => return Err(error),
                }
                self.connection.purge(uid).await
            };
            self.runtime.block_on(deleting)?;
        }
        self.local.delete(uid)
    }

    fn changes(&self) -> Option<watch::Receiver<()>> {
        Some(self.changed.subscribe())
    }
}

impl Named {
    fn is(&self, uid: Uid) -> bool {
        self.uid == uid.to_string()
    }
}

/// The key of a name: NATS does not allow all characters.
fn key(name: &str) -> String {
    URL_SAFE_NO_PAD.encode(name)
}

/// Notes a value unless a newer one is known; true if that changed anything.
fn note(known: &watch::Sender<Known>, named: Named, revision: u64) -> bool {
    known.send_if_modified(|known| {
        if known
            .get(&named.name)
            .is_some_and(|(_, known)| *known >= revision)
        {
            return false;
        }
        known.insert(named.name.clone(), (named, revision));
        true
    })
}

/// The present content of a bucket.
async fn read_all(bucket: &kv::Store) -> Result<Known, LogError> {
    let mut known = Known::new();
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
async fn follow(bucket: kv::Store, known: Arc<watch::Sender<Known>>, changed: watch::Sender<()>) {
    let mut attempts = interval(RETRY_INTERVAL);
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

fn read(value: &Bytes) -> Option<Named> {
    let named = serde_json::from_slice(value);
    named
        .inspect_err(|error| warn!(%error, "the catalogue in NATS has an entry that is not one of Wayfold's"))
        .ok()
}
