//! fjall alone, with group commit, writing the same bytes as our log: the limit for a store of this kind.
//!
//! The writers are not ordered, the benchmark computes nothing, and it reads nothing.

use std::{
    fs::{self, File},
    path::PathBuf,
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    thread,
};

use fjall::{Database, Keyspace, KeyspaceCreateOptions, PersistMode};
use tempfile::TempDir;
use tokio::{sync::watch, task::JoinSet};

use crate::{CLIENTS, base_directory::BaseDirectory, shape::Shape};

/// The distance from an added key to the removed one: the number of records that our window keeps.
const WINDOW_RECORDS: u64 = 12_000;
/// Our log uses the same size.
const JOURNAL_BYTES: u64 = 128 * 1024 * 1024;

/// A way to share a sync.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum SyncSharing {
    /// 64 threads. A thread that finds no sync in progress calls `persist(SyncData)` for all.
    Leader,
    /// 64 threads, and one more that calls `persist(SyncData)`.
    Thread,
    /// 64 tasks, and a thread that calls `persist(SyncData)`.
    Tasks,
    /// 64 tasks, and a thread that calls `persist(Buffer)` and syncs the file of the journal itself, so that others
    /// write meanwhile. Like our log, it relies on the file layout of fjall.
    FileSync,
}

impl SyncSharing {
    pub(crate) const ALL: [SyncSharing; 4] = [
        SyncSharing::Leader,
        SyncSharing::Thread,
        SyncSharing::Tasks,
        SyncSharing::FileSync,
    ];

    pub(crate) fn name(self) -> &'static str {
        match self {
            SyncSharing::Leader => "64 threads, a leader persists",
            SyncSharing::Thread => "64 threads, a thread persists",
            SyncSharing::Tasks => "64 tasks, a thread persists",
            SyncSharing::FileSync => "64 tasks, a thread syncs beside",
        }
    }
}

/// An open store and the state of its syncing.
pub(crate) struct BareStore {
    writing: Arc<WriteState>,
    way: SyncSharing,
    syncer: Option<thread::JoinHandle<()>>,
    _directory: TempDir,
}

struct WriteState {
    database: Database,
    keyspace: Keyspace,
    path: PathBuf,
    shape: Shape,
    next: AtomicU64,
    round: Mutex<Round>,
    wake: Condvar,
    done: Condvar,
    synced: watch::Sender<u64>,
}

#[derive(Default)]
struct Round {
    committed: u64,
    synced: u64,
    syncing: bool,
    stop: bool,
}

impl BareStore {
    pub(crate) fn open(base: &BaseDirectory, shape: &Shape, way: SyncSharing) -> Self {
        let directory = base.create();
        let path = directory.path().join("store");
        let database = Database::builder(&path)
            .max_journaling_size(JOURNAL_BYTES)
            .manual_journal_persist(true)
            .open()
            .expect("a store");
        let keyspace = database.keyspace("all", KeyspaceCreateOptions::default);
        let writing = Arc::new(WriteState {
            keyspace: keyspace.expect("a keyspace"),
            database,
            path,
            shape: shape.clone(),
            next: AtomicU64::new(WINDOW_RECORDS),
            round: Mutex::default(),
            wake: Condvar::new(),
            done: Condvar::new(),
            synced: watch::Sender::new(0),
        });
        let syncing = Arc::clone(&writing);
        let syncer = (way != SyncSharing::Leader).then(|| thread::spawn(move || syncing.run(way)));
        Self {
            writing,
            way,
            syncer,
            _directory: directory,
        }
    }

    /// Returns once 64 writers together have `count` acknowledged writes.
    pub(crate) async fn write(&self, count: usize) {
        let each = count / CLIENTS;
        if matches!(self.way, SyncSharing::Leader | SyncSharing::Thread) {
            let (writing, way) = (Arc::clone(&self.writing), self.way);
            let all = tokio::task::spawn_blocking(move || {
                thread::scope(|scope| {
                    for _ in 0..CLIENTS {
                        scope.spawn(|| {
                            for _ in 0..each {
                                writing.commit();
                                writing.settle(way);
                            }
                        });
                    }
                });
            });
            all.await.expect("writers that end");
        } else {
            let mut writers = JoinSet::new();
            for _ in 0..CLIENTS {
                let writing = Arc::clone(&self.writing);
                let mut synced = writing.synced.subscribe();
                writers.spawn(async move {
                    for _ in 0..each {
                        writing.commit();
                        let mine = writing.announce();
                        let reached = synced.wait_for(|synced| *synced >= mine).await;
                        drop(reached.expect("a syncer"));
                    }
                });
            }
            writers.join_all().await;
        }
    }
}

impl Drop for BareStore {
    fn drop(&mut self) {
        self.writing.round().stop = true;
        self.writing.wake.notify_one();
        if let Some(syncer) = self.syncer.take() {
            syncer.join().expect("a syncer that ends");
        }
    }
}

impl WriteState {
    fn round(&self) -> MutexGuard<'_, Round> {
        self.round.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The batch of one insert.
    fn commit(&self) {
        let number = self.next.fetch_add(1, Ordering::Relaxed);
        let counted = |key: &[u8], number: u64| {
            let mut key = key.to_vec();
            if let Some(end) = key.last_chunk_mut() {
                *end = number.to_be_bytes();
            }
            key
        };
        let mut batch = self.database.batch();
        for (key, value) in &self.shape.added {
            batch.insert(&self.keyspace, counted(key, number), value.as_slice());
        }
        for (key, value) in &self.shape.changed {
            batch.insert(&self.keyspace, key.as_slice(), value.as_slice());
        }
        for key in &self.shape.removed {
            batch.remove(&self.keyspace, counted(key, number - WINDOW_RECORDS));
        }
        batch.commit().expect("a store that takes it");
    }

    /// Announces a commit, and returns its number.
    fn announce(&self) -> u64 {
        let mut round = self.round();
        round.committed += 1;
        let mine = round.committed;
        drop(round);
        self.wake.notify_one();
        mine
    }

    /// Returns once the writes that this thread has committed are synced.
    fn settle(&self, way: SyncSharing) {
        let mine = self.announce();
        let mut round = self.round();
        while round.synced < mine {
            if way == SyncSharing::Leader && !round.syncing {
                round.syncing = true;
                let upto = round.committed;
                drop(round);
                self.database
                    .persist(PersistMode::SyncData)
                    .expect("a sync");
                round = self.round();
                round.synced = upto;
                round.syncing = false;
                self.done.notify_all();
            } else {
                round = self
                    .done
                    .wait(round)
                    .unwrap_or_else(PoisonError::into_inner);
            }
        }
    }

    /// The thread that syncs.
    fn run(&self, way: SyncSharing) {
        let mut journal = None;
        loop {
            let mut round = self.round();
            while round.committed == round.synced && !round.stop {
                round = self
                    .wake
                    .wait(round)
                    .unwrap_or_else(PoisonError::into_inner);
            }
            if round.stop {
                return;
            }
            let upto = round.committed;
            drop(round);
            if way == SyncSharing::FileSync {
                self.database.persist(PersistMode::Buffer).expect("a sync");
                self.newest(&mut journal).sync_data().expect("a sync");
            } else {
                self.database
                    .persist(PersistMode::SyncData)
                    .expect("a sync");
            }
            self.round().synced = upto;
            self.done.notify_all();
            self.synced.send_replace(upto);
        }
    }

    /// The current file of the journal: the one with the largest number.
    fn newest<'a>(&self, known: &'a mut Option<(u64, File)>) -> &'a File {
        let files = fs::read_dir(&self.path).expect("a directory");
        let numbers = files.filter_map(|file| {
            let name = file.expect("an entry").file_name();
            name.to_str()?.strip_suffix(".jnl")?.parse::<u64>().ok()
        });
        let newest = numbers.max().expect("a journal");
        if known.as_ref().is_none_or(|(number, _)| *number != newest) {
            let file = File::options()
                .write(true)
                .open(self.path.join(format!("{newest}.jnl")));
            *known = Some((newest, file.expect("a journal")));
        }
        &known.as_ref().expect("a journal").1
    }
}
