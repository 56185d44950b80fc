//! A journal that ends before the records that a server has applied.

use std::{
    fs,
    sync::{
        OnceLock, Weak,
        atomic::{AtomicU64, Ordering::SeqCst},
    },
};

use bytes::Bytes;
use futures_util::{StreamExt, stream};
use wayfold_index::PointRef;

use super::*;
use crate::{
    log::{
        Catalogue, Durability, Effects, FjallLog, Journal, Log, MemoryLog, Origin, Outcome,
        PointStore, Record, RecordPosition, RecordStream, Sessions, Uid,
    },
    registry::{CommitOutcome, RegistryOptions, in_flight::Decision},
    testing::{self, arm, forward_journal, recorded},
};

const APPLIED: u64 = 3;

/// A journal that ends early.
struct SetBack {
    local: Arc<MemoryLog>,
    /// True if it has another record in the place of a lost one; otherwise this server does not keep the lost records.
    is_other: bool,
    /// Its newest revision.
    head: AtomicU64,
    /// The number of times that it was followed.
    follows: AtomicU64,
}

impl Journal for SetBack {
    forward_journal!(local);

    fn follow(&self, uid: Uid, after: u64) -> RecordStream {
        self.follows.fetch_add(1, SeqCst);
        let head = self.head.load(SeqCst);
        if head >= after {
            return self.local.follow(uid, after);
        }
        let behind = LogError::JournalBehind {
            uid,
            head,
            applied: after,
        };
        stream::once(async { Err(behind) }).boxed()
    }

    fn newest(&self, _: Uid) -> Result<u64, LogError> {
        Ok(self.head.load(SeqCst))
    }

    fn repair(&self, uid: Uid) -> Result<u64, LogError> {
        let head = self.head.load(SeqCst);
        Err(match self.is_other {
            true => LogError::Contradicted {
                uid,
                revision: head,
                member: "another server".into(),
            },
            false => LogError::trimmed(uid, head, APPLIED),
        })
    }
}

impl SetBack {
    fn new(local: &Arc<MemoryLog>, is_other: bool, head: u64) -> Arc<Self> {
        Arc::new(Self {
            local: Arc::clone(local),
            is_other,
            head: AtomicU64::new(head),
            follows: AtomicU64::new(0),
        })
    }
}

/// A server whose index has applied more than its journal has, once it has stopped.
async fn stopped(is_other: bool) -> (Arc<SetBack>, Arc<Registry>, Arc<Hosted>) {
    let local = recorded(APPLIED);
    let journal = SetBack::new(&local, is_other, 1);
    let registry = testing::registry(&journal, &local, RegistryOptions::default());
    let registry = Arc::new(registry);
    let hosted = registry.get("arm").unwrap();
    assert!(hosted.reached(u64::MAX).await.is_err());
    assert!(hosted.is_ahead());
    (journal, registry, hosted)
}

#[tokio::test(flavor = "multi_thread")]
async fn an_index_ahead_of_a_journal_that_cannot_be_repaired_stays_stopped() {
    let (journal, registry, hosted) = stopped(false).await;
    registry.resume_unsettled(&hosted).await;
    assert_eq!(journal.follows.load(SeqCst), 1);
    assert!(hosted.is_ahead());

    // Another server repairs it.
    journal.head.store(APPLIED, SeqCst);
    registry.resume_unsettled(&hosted).await;
    assert!(!hosted.is_closed());
    let position = journal.local.view(hosted.uid()).unwrap().position();
    let next = Record::after(position, Effects::new(1));
    journal.submit(hosted.uid(), Arc::new(next)).unwrap();
    hosted.reached(APPLIED + 1).await.unwrap();
}

/// The journal has another record in the place of one that it has lost.
#[tokio::test(flavor = "multi_thread")]
async fn an_index_ahead_of_another_history_is_contradicted() {
    let (journal, registry, hosted) = stopped(true).await;
    registry.resume_unsettled(&hosted).await;
    let why = hosted.damage().unwrap().to_string();
    let expected = "another server has applied another record of revision 1";
    assert!(why.contains(expected) && why.contains("reseed"), "{why}");
    // No copy takes its place, and it does not resume once the journal is longer.
    assert!(registry.stopped().is_empty() && !hosted.is_unsettled() && registry.has_damage());
    journal.head.store(APPLIED, SeqCst);
    registry.resume_unsettled(&hosted).await;
    assert!(hosted.is_closed());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_contradicted_index_does_not_resume() {
    let (journal, registry, hosted) = stopped(false).await;
    registry.close_contradicted(hosted.uid(), APPLIED, "peer");
    journal.head.store(APPLIED, SeqCst);
    let resuming = (Arc::clone(&registry), Arc::clone(&hosted));
    let resumed = tokio::task::spawn_blocking(move || resuming.0.resumes(&resuming.1));
    assert!(!resumed.await.unwrap());
    let why = hosted.damage().unwrap();
    assert!(
        matches!(why, RegistryError::Log(LogError::Contradicted { .. })),
        "{why}"
    );
    assert!(registry.stopped().is_empty());

    // A contradiction closes no index that follows its journal again.
    let (journal, registry, hosted) = stopped(false).await;
    journal.head.store(APPLIED, SeqCst);
    registry.resume_unsettled(&hosted).await;
    registry.close_contradicted(hosted.uid(), APPLIED, "peer");
    assert!(!hosted.is_closed());
}

/// The store had failed in the middle of a pack, and the journal has more.
#[tokio::test(flavor = "multi_thread")]
async fn an_index_resumes_at_the_revision_of_its_store() {
    let (journal, _registry, hosted) = stopped(false).await;
    let (uid, local) = (hosted.uid(), &journal.local);
    let mut position = local.view(uid).unwrap().position();
    let records = [(), (), ()].map(|()| {
        let record = Arc::new(Record::after(position, Effects::new(1)));
        position = record.position();
        local.submit(uid, Arc::clone(&record)).unwrap();
        record
    });
    journal.head.store(APPLIED + 3, SeqCst);
    let stored = local.apply(uid, &records[..1]).unwrap();
    let resuming = Arc::clone(&hosted);
    let resumed =
        tokio::task::spawn_blocking(move || (resuming.resume(&stored), resuming.published()));
    let (resumed, published) = resumed.await.unwrap();
    assert!(resumed && published.revision > APPLIED);
    assert_eq!(published.revision, published.view.position().revision);
    hosted.reached(APPLIED + 3).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_record_that_was_submitted_while_the_index_closed_does_not_block_later_ones() {
    let (journal, registry, hosted) = stopped(false).await;
    let position = RecordPosition {
        revision: APPLIED + 1,
        digest: [1; 32],
    };
    let submitted = {
        let mut in_flight = hosted.in_flight.lock();
        let refusals = in_flight.refusals();
        in_flight.add(position, refusals).unwrap()
    };
    journal.head.store(APPLIED, SeqCst);
    registry.resume_unsettled(&hosted).await;
    assert!(matches!(submitted.await, Ok(Decision::Failed(_))));
    assert_eq!(hosted.in_flight.lock().len(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_index_whose_points_cannot_be_read_may_take_a_copy() {
    let (_journal, registry, hosted) = stopped(false).await;
    let uid = hosted.uid();
    hosted.close(RegistryError::Log(LogError::Unreadable {
        uid,
        what: "a block has another checksum".into(),
    }));
    assert!(registry.has_damage());
    let stopped = registry.stopped().pop().unwrap();
    assert_eq!((stopped.uid, stopped.min_revision), (uid, APPLIED));
}

/// The panic may have left its forest half changed.
#[tokio::test(flavor = "multi_thread")]
async fn an_index_that_a_panic_stopped_is_replayed_once_the_log_is_reopened() {
    let registry = Registry::new(recorded(APPLIED), RegistryOptions::default());
    registry.replay().unwrap();
    let registry = Arc::new(registry);
    let before = registry.get("arm").unwrap();
    before.end_loop(0, RegistryError::Stopped);
    assert!(before.is_closed());
    let recovering = Arc::clone(&registry);
    let recovered = tokio::task::spawn_blocking(move || recovering.recover());
    recovered.await.unwrap().unwrap();
    let after = registry.get("arm").unwrap();
    assert!(!Arc::ptr_eq(&before, &after) && !after.is_closed());
    assert_eq!(after.published().revision, APPLIED);
}

fn is_of_copy(why: &RegistryError) -> bool {
    matches!(why, RegistryError::Log(LogError::CopyUnreadable { .. }))
}

/// A store that has failed cannot create the index of another server.
#[tokio::test]
async fn an_index_that_the_store_lacks_is_not_deleted() {
    let named = recorded(APPLIED);
    let log = Log {
        journal: SetBack::new(&named, false, APPLIED),
        points: Arc::new(MemoryLog::new()),
        catalogue: named,
    };
    let registry = Registry::new(log, RegistryOptions::default());
    registry.replay().unwrap();
    let why = registry.get("arm").err().unwrap();
    assert!(is_of_copy(&why), "{why}");
}

#[tokio::test]
async fn without_its_store_a_server_refuses_restores_and_deletes_as_unreadable() {
    let [directory, elsewhere] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let open = || FjallLog::open(directory.path(), Durability::Fsync).unwrap();
    open().create(arm()).unwrap();
    let store = directory.path().join("store");
    fs::rename(store, elsewhere.path().join("store")).unwrap();
    let log = Log {
        journal: SetBack::new(&Arc::new(MemoryLog::new()), false, APPLIED),
        ..Log::from(Arc::new(open()))
    };
    let registry = Registry::new(log, RegistryOptions::default());
    registry.replay().unwrap();
    let what = ("R1".parse().unwrap(), Default::default());
    let restored = registry.restore("leg", what, Vec::new(), Origin::START);
    for why in [restored.err(), registry.delete("arm", None).err()] {
        let why = why.unwrap();
        assert!(is_of_copy(&why), "{why}");
    }
}

/// A catalogue whose registry adopts a claim before the claim is answered.
struct Adopted {
    local: Arc<MemoryLog>,
    registry: OnceLock<Weak<Registry>>,
}

impl Catalogue for Adopted {
    fn indexes(&self) -> Result<Vec<Entry>, LogError> {
        self.local.indexes()
    }

    fn create(&self, entry: Entry) -> Result<(), LogError> {
        self.local.create(entry)
    }

    fn claim(&self, _: &Entry, _: Option<Uid>) -> Result<(), LogError> {
        let registry = self.registry.get().and_then(Weak::upgrade).unwrap();
        assert!(registry.change_lock.try_lock().is_some(), "it is locked");
        registry.refresh().unwrap();
        Ok(())
    }

    fn delete(&self, uid: Uid) -> Result<(), LogError> {
        self.local.delete(uid)
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_restore_holds_no_lock_while_its_name_is_claimed() {
    let local = Arc::new(MemoryLog::new());
    let catalogue = Arc::new(Adopted {
        local: Arc::clone(&local),
        registry: OnceLock::new(),
    });
    let log = Log {
        journal: SetBack::new(&local, false, 0),
        points: local,
        catalogue: Arc::clone(&catalogue) as Arc<dyn Catalogue>,
    };
    let registry = Arc::new(Registry::new(log, RegistryOptions::default()));
    catalogue.registry.set(Arc::downgrade(&registry)).unwrap();
    let restoring = Arc::clone(&registry);
    let restored = tokio::task::spawn_blocking(move || {
        let what = ("R1".parse().unwrap(), Default::default());
        let restore = restoring.restore("arm", what, Vec::new(), Origin::START)?;
        restoring.host(restore, Sessions::default())
    });
    let hosted = restored.await.unwrap().unwrap();
    // The index is served once.
    assert!(Arc::ptr_eq(&registry.get("arm").unwrap(), &hosted));
    assert!(!hosted.is_closed());
}

#[tokio::test]
async fn an_idle_index_holds_no_former_revision() {
    let registry = Registry::new(recorded(1), RegistryOptions::default());
    registry.replay().unwrap();
    let hosted = registry.get("arm").unwrap();
    let former = Arc::downgrade(&hosted.published());
    let mut effects = Effects::new(1);
    effects.store(
        PointRef {
            id: 0,
            tag: 0,
            revision: 2,
            row: &[0.5],
        },
        Outcome::Inserted,
        Bytes::new(),
    );
    let writer = hosted.write().await.unwrap();
    let committed = hosted.commit(writer, effects).await.unwrap();
    assert_eq!(committed, CommitOutcome::Done);
    // The second call finds that no mutation came since the first.
    hosted.merge_if_idle();
    hosted.merge_if_idle();
    assert!(former.upgrade().is_none());
}
