//! A point store that a test makes busy, below a shared journal.

use std::{
    sync::atomic::AtomicBool,
    thread::{self, ThreadId},
};

use wayfold_index::PointRef;

use super::*;
use crate::{
    log::{Entry, Log, MemoryLog, Origin, Outcome, PointStore, PointWriter, Retention, Window},
    testing::forward_journal,
};

struct BusyStore {
    memory: Arc<MemoryLog>,
    is_busy: AtomicBool,
    /// The thread that last applied records to it.
    applied_by: Mutex<Option<ThreadId>>,
}

impl Journal for BusyStore {
    forward_journal!(memory);

    fn follow(&self, uid: Uid, after: u64) -> RecordStream {
        self.memory.follow(uid, after)
    }

    fn newest(&self, uid: Uid) -> Result<u64, LogError> {
        self.memory.newest(uid)
    }

    fn is_busy(&self) -> bool {
        self.is_busy.load(Relaxed)
    }
}

impl PointStore for BusyStore {
    fn apply(&self, uid: Uid, records: &[Arc<Record>]) -> Result<Arc<dyn View>, LogError> {
        *self.applied_by.lock() = Some(thread::current().id());
        self.memory.apply(uid, records)
    }

    fn view(&self, uid: Uid) -> Result<Arc<dyn View>, LogError> {
        self.memory.view(uid)
    }

    fn trim(&self, uid: Uid, retention: &Retention) -> Result<(), LogError> {
        self.memory.trim(uid, retention)
    }

    fn window(&self, uid: Uid) -> Result<Window, LogError> {
        self.memory.window(uid)
    }

    fn operations(&self, uid: Uid) -> Result<Vec<Arc<Operation>>, LogError> {
        self.memory.operations(uid)
    }

    fn restore(
        &self,
        entry: Entry,
        origin: Origin,
        replaces: bool,
    ) -> Result<Box<dyn PointWriter>, LogError> {
        self.memory.restore(entry, origin, replaces)
    }
}

/// The effects of a point that is stored.
fn stored(id: u64, revision: u64, outcome: Outcome) -> Effects {
    let mut effects = Effects::new(1);
    let point = PointRef {
        id,
        tag: 0,
        revision,
        row: &[0.5],
    };
    effects.store(point, outcome, Default::default());
    effects
}

fn removed(id: u64) -> Effects {
    let mut effects = Effects::new(1);
    effects.remove(id);
    effects
}

/// With a shared journal the records are first written when they are applied.
#[tokio::test]
async fn records_that_wait_for_the_disk_are_applied_on_another_thread() {
    let memory = recorded(0);
    let store = Arc::new(BusyStore {
        memory: Arc::clone(&memory),
        is_busy: AtomicBool::new(false),
        applied_by: Mutex::default(),
    });
    let log = Log {
        journal: Arc::<RemoteJournal>::default(),
        points: Arc::clone(&store) as Arc<dyn PointStore>,
        catalogue: memory,
    };
    let registry = Registry::new(log, RegistryOptions::default());
    registry.replay().unwrap();
    let hosted = registry.get("arm").unwrap();
    let mut position = hosted.published().view.position();
    for (effects, is_busy, elsewhere) in [
        (stored(7, 1, Outcome::Inserted), false, false),
        (stored(7, 2, Outcome::Replaced), false, true),
        (removed(7), false, true),
        (stored(8, 4, Outcome::Inserted), true, true),
    ] {
        store.is_busy.store(is_busy, Relaxed);
        let record = Arc::new(Record::after(position, effects));
        position = record.position();
        hosted.apply(vec![record]).await.unwrap();
        let caller = thread::current().id();
        assert_eq!(store.applied_by.lock().take() != Some(caller), elsewhere);
    }
}
