//! Replaces an index that cannot follow its journal by a copy of another server, under the same uid.

use std::sync::Arc;

use tracing::info;

use super::{
    Hosted, IndexState, Registry, RegistryError, Restore, replay::replay_or_damaged,
    restore::unloaded,
};
use crate::log::{Operation, Origin, RecordPosition, Sessions, Uid};

impl Registry {
    /// Begins to replace an index by the points of another server at its newest record or a later one. `origin` has the digest
    /// of that record. Readers keep the old points until [`Registry::host_replaced`]. [`RegistryError::Follows`] if the
    /// index is not closed. Blocks on the log.
    pub fn replace(&self, uid: Uid, origin: Origin) -> Result<Restore, RegistryError> {
        // A shared catalogue creates and deletes indices of the point store while it is read.
        let _change = self.change_lock.lock();
        let entries = self.host.log.catalogue.indexes()?;
        let entry = entries.into_iter().find(|entry| entry.uid == uid);
        let entry = entry.ok_or(RegistryError::Deleted)?;
        let state = self.indexes.read().get(&entry.name).cloned();
        match state {
            Some(IndexState::Hosted(hosted)) if !hosted.is_closed() => {
                return Err(RegistryError::Follows);
            }
            Some(state) if state.uid() == uid => {}
            _ => return Err(RegistryError::Deleted),
        }
        self.host.watermarks.check()?;
        Restore::begin(&self.host, entry, origin, true)
    }

    /// Hosts the copy of [`Registry::replace`], which has all its points, with these writer sessions and these operations,
    /// oldest first. `compared` is the newest record that the index had when the other server compared it, if it was served:
    /// [`RegistryError::Follows`] if it has others now, which the copy may lack. The copy follows the journal from there on.
    /// The calls that wait for the old index fail and can be retried. Blocks on the log and on building the forest.
    pub fn host_replaced(
        &self,
        restore: Restore,
        compared: Option<RecordPosition>,
        sessions: Sessions,
        operations: Vec<Arc<Operation>>,
    ) -> Result<Arc<Hosted>, RegistryError> {
        let Restore {
            host,
            entry,
            origin,
            stored,
            loader,
            counted: _,
        } = restore;
        let points = loader.len;
        let loaded = loader.finish(origin.revision).map_err(unloaded)?;
        let _change = self.change_lock.lock();
        let state = self.indexes.read().get(&entry.name).cloned();
        match &state {
            Some(state) if state.uid() != entry.uid => return Err(RegistryError::Deleted),
            // From here on the old index does not touch the store.
            Some(IndexState::Hosted(old)) if !old.retire(compared) => {
                return Err(RegistryError::Follows);
            }
            Some(_) => {}
            None => return Err(RegistryError::Deleted),
        }
        let put = |state| self.change(|indexes| indexes.insert(entry.name.clone(), state));
        let view = stored.finish(sessions, operations.clone());
        let view = view.and_then(|()| host.log.points.view(entry.uid));
        let view = match view {
            Ok(view) => view,
            Err(why) => {
                put(replay_or_damaged(&host, &entry));
                return Err(why.into());
            }
        };
        let hosted = Hosted::new(&host, &entry, loaded, view, operations);
        if let Some(IndexState::Hosted(old)) = &state {
            hosted.take_session_uses(old);
        }
        let (revision, index) = (origin.revision, &entry.name);
        info!(index, uid = %entry.uid, revision, points, "replaced an index by a copy of another server");
        put(IndexState::Hosted(Arc::clone(&hosted)));
        Ok(hosted)
    }
}

#[cfg(test)]
mod tests {
    use std::{
        sync::{
            OnceLock, Weak,
            atomic::{AtomicBool, Ordering::Relaxed},
        },
        time::{Duration, Instant},
    };

    use super::*;
    use crate::{
        log::{Catalogue, Entry, Journal, Log, LogError, MemoryLog, PointStore},
        registry::RegistryOptions,
        testing::{arm, log_with, submit, trim_all},
    };

    /// A catalogue that notes if its registry reads it without the lock on changes.
    #[derive(Default)]
    struct Watched {
        local: Arc<MemoryLog>,
        registry: OnceLock<Weak<Registry>>,
        is_unlocked: AtomicBool,
    }

    impl Catalogue for Watched {
        fn indexes(&self) -> Result<Vec<Entry>, LogError> {
            let registry = self.registry.get().and_then(Weak::upgrade);
            if registry.is_some_and(|registry| registry.change_lock.try_lock().is_some()) {
                self.is_unlocked.store(true, Relaxed);
            }
            self.local.indexes()
        }

        fn create(&self, entry: Entry) -> Result<(), LogError> {
            self.local.create(entry)
        }

        fn delete(&self, uid: Uid) -> Result<(), LogError> {
            self.local.delete(uid)
        }
    }

    /// A copy of all that a peer has, which has compared the records up to this one.
    fn copy(
        registry: &Registry,
        peer: &MemoryLog,
        uid: Uid,
        compared: RecordPosition,
    ) -> Result<Arc<Hosted>, RegistryError> {
        let view = peer.view(uid).unwrap();
        let position = view.position();
        let origin = Origin {
            revision: position.revision,
            next_id: view.next_id(),
            digest: position.digest,
        };
        let mut restore = registry.replace(uid, origin)?;
        for point in view.page(None, 100).unwrap() {
            restore.add(std::slice::from_ref(&*point))?;
        }
        let operations = peer.operations(uid).unwrap();
        registry.host_replaced(restore, Some(compared), view.sessions().clone(), operations)
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn an_index_behind_a_trimmed_journal_goes_on_from_a_copy() {
        let entry = arm();
        let (peer, local) = (log_with(&entry, &[]), log_with(&entry, &[]));
        let uid = entry.uid;
        let catalogue = Arc::new(Watched {
            local: Arc::clone(&local),
            ..Watched::default()
        });
        let log = Log {
            journal: Arc::clone(&peer) as Arc<dyn Journal>,
            points: local,
            catalogue: Arc::clone(&catalogue) as Arc<dyn Catalogue>,
        };
        (0..5).for_each(|_| submit(&peer, uid));
        trim_all(&peer, uid);
        let registry = Arc::new(Registry::new(log, RegistryOptions::default()));
        registry.replay().unwrap();
        let old = registry.get("arm").unwrap();
        let trimmed = old.reached(5).await.err();
        assert!(
            matches!(trimmed, Some(RegistryError::Log(LogError::Trimmed { .. }))),
            "{trimmed:?}"
        );
        catalogue.registry.set(Arc::downgrade(&registry)).unwrap();
        let copying = |compared: RecordPosition| {
            let (registry, peer) = (Arc::clone(&registry), Arc::clone(&peer));
            tokio::task::spawn_blocking(move || copy(&registry, &peer, uid, compared))
        };
        let compared = old.published().view.position();
        old.session_uses.lock().insert(7, Instant::now());
        // It has other records than those that were compared.
        let other = peer.view(uid).unwrap().position();
        let refused = copying(other).await.unwrap().err();
        assert_eq!(refused, Some(RegistryError::Follows));
        let hosted = copying(compared).await.unwrap().unwrap();
        assert_eq!(hosted.published().revision, 5);
        assert_eq!(hosted.published().snapshot.len(), 5);
        for revision in 1..=5 {
            let id = format!("operation {revision}");
            assert!(hosted.operations.lock().recall(&id).is_some(), "{id}");
        }
        assert!(Arc::ptr_eq(&registry.get("arm").unwrap(), &hosted));
        assert!(hosted.is_session_used_within(7, Duration::from_secs(60)));
        // A holder of the old index reads on, and neither waits nor writes.
        assert_eq!(old.published().revision, 0);
        assert!(old.write().await.is_err());
        let view = old.published().view.clone();
        assert!(
            !tokio::task::spawn_blocking(move || old.resume(&view))
                .await
                .unwrap()
        );
        // It follows from the copy on, and no other copy takes its place.
        submit(&peer, uid);
        assert_eq!(hosted.reached(6).await.unwrap().snapshot.len(), 6);
        let refused = copying(compared).await.unwrap().err();
        assert_eq!(refused, Some(RegistryError::Follows));
        registry.load_rest();
        assert!(!catalogue.is_unlocked.load(Relaxed));
    }
}
