//! One measurement of each kind.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use arc_swap::ArcSwap;
use tokio::{sync::mpsc, task::JoinSet};
use wayfold::{Client, IndexHandle};
use wayfold_index::{Forest, ForestOptions, Merged, Points, Search, Snapshot};
use wayfold_tests::{States, Stubs, figures::thread_time};
use zenoh::Session;

use crate::{
    K, SPACE, WIDTH,
    feed::{FeedCost, Inserted, feed},
};

/// The number of query states, drawn in advance and used repeatedly.
const POOL: usize = 4_096;
/// The number of merges that a replica runs at once.
const MERGERS: usize = 2;

/// The setting of a measurement.
pub(crate) struct Setting {
    pub(crate) points: usize,
    pub(crate) batch: usize,
    pub(crate) calls_per_second: usize,
    pub(crate) seconds: usize,
    /// The Zenoh session on which the replica receives mutations, if it does not use gRPC.
    pub(crate) session: Option<Session>,
}

/// The rates at which one thread was answered.
#[derive(Clone, Copy)]
pub(crate) struct QueryRates {
    /// Queries per second of its processor time.
    pub(crate) by_processor: f64,
    /// Queries per second.
    pub(crate) by_clock: f64,
}

/// The result of measuring a replica.
pub(crate) struct ReplicaFigures {
    pub(crate) asked: QueryRates,
    pub(crate) fed: FeedCost,
    /// The time from the acknowledgement of each insert to its arrival in the replica.
    pub(crate) lags: Vec<Duration>,
    /// The time from the sending of each insert to its arrival in the replica.
    pub(crate) lags_from_sending: Vec<Duration>,
}

/// Creates a separate index with the initial points, and returns these too.
async fn index(client: &Client, setting: &Setting, name: String) -> (IndexHandle, Vec<f64>) {
    let space = SPACE.parse().expect("a space");
    let index = client.create_index(&name, &space).await.expect("an index");
    let rows = States::new(space, 7).rows(setting.points);
    let inserted = index.insert(rows.chunks(WIDTH)).await;
    inserted.expect("an insert");
    (index, rows)
}

/// Queries a replica while it follows.
pub(crate) async fn replica(
    client: &Client,
    echo: &Stubs,
    setting: &Setting,
    round: u64,
) -> ReplicaFigures {
    let (index, _) = index(client, setting, format!("replica-{round}")).await;
    let mut request = client.replica(index.name());
    if let Some(session) = &setting.session {
        request = request.over_zenoh(session.clone(), "wayfold/v1");
    }
    let replica = request.await.expect("a replica");
    let search = {
        let replica = replica.clone();
        move |state: &[f64]| {
            let found = replica.knn(state, K).expect("an answer");
            found.len()
        }
    };
    let asking = QueryThread::start(round, search);
    let (reports, mut inserted) = mpsc::unbounded_channel::<Inserted>();
    let watched = tokio::spawn(async move {
        let mut waits = JoinSet::new();
        while let Some(insert) = inserted.recv().await {
            let replica = replica.clone();
            waits.spawn(async move {
                let reached = replica.at_least(&insert.revision).await;
                reached.expect("the revision");
                (insert.acknowledged.elapsed(), insert.sent.elapsed())
            });
        }
        waits.join_all().await
    });
    let fed = feed(&index, echo, setting, round, reports).await;
    let asked = asking.stop();
    let (lags, lags_from_sending) = watched.await.expect("the watcher").into_iter().unzip();
    client.delete_index(index.name()).await.expect("a deletion");
    ReplicaFigures {
        asked,
        fed,
        lags,
        lags_from_sending,
    }
}

/// Queries a forest that receives the same inserts at the same rate, without a replica.
pub(crate) async fn forest(
    client: &Client,
    echo: &Stubs,
    setting: &Setting,
    round: u64,
) -> QueryRates {
    let (index, rows) = index(client, setting, format!("forest-{round}")).await;
    let mut forest = Forest::new(
        index.space().clone(),
        ForestOptions::for_space(index.space()),
    );
    forest
        .apply(1, &points(&index, &rows, 0, 1), &[])
        .expect("canonical states");
    forest.settle();
    let published = Arc::new(ArcSwap::from_pointee(forest.snapshot()));
    let search = {
        let published = Arc::clone(&published);
        move |state: &[f64]| {
            let answer = published
                .load()
                .search(state, &Search::nearest_k(K as usize))
                .expect("canonical states");
            answer.neighbors.len()
        }
    };
    let asking = QueryThread::start(round, search);
    let (reports, inserted) = mpsc::unbounded_channel();
    let fed_with = index.clone();
    let applied = tokio::spawn(apply_all(fed_with, forest, published, inserted));
    feed(&index, echo, setting, round, reports).await;
    let asked = asking.stop();
    applied.await.expect("the applier");
    client.delete_index(index.name()).await.expect("a deletion");
    asked
}

/// Applies the inserted points and publishes them, with merges in the background.
async fn apply_all(
    index: IndexHandle,
    mut forest: Forest,
    published: Arc<ArcSwap<Snapshot>>,
    mut inserted: mpsc::UnboundedReceiver<Inserted>,
) {
    let mut merges: JoinSet<Merged> = JoinSet::new();
    let mut next_id = forest.len() as u64;
    loop {
        tokio::select! {
            insert = inserted.recv() => {
                let Some(insert) = insert else { return };
                let revision = forest.revision() + 1;
                let stored = points(&index, &insert.rows, next_id, revision);
                next_id += stored.len() as u64;
                forest.apply(revision, &stored, &[]).expect("canonical states");
            }
            Some(merged) = merges.join_next() => forest.finish_merge(merged.expect("a merge")),
        }
        published.store(Arc::new(forest.snapshot()));
        while merges.len() < MERGERS
            && let Some(merge) = forest.begin_merge()
        {
            merges.spawn_blocking(move || merge.run());
        }
    }
}

fn points(index: &IndexHandle, rows: &[f64], first_id: u64, revision: u64) -> Points {
    let mut points = Points::new(WIDTH);
    for (row, id) in rows.chunks(WIDTH).zip(first_id..) {
        let mut row = row.to_vec();
        index.space().canonicalize(&mut row).expect("a state");
        points.push(id, 0, revision, &row);
    }
    points
}

/// A thread that queries without pause.
struct QueryThread {
    stop: Arc<AtomicBool>,
    thread: thread::JoinHandle<QueryRates>,
}

impl QueryThread {
    fn start(seed: u64, search: impl Fn(&[f64]) -> usize + Send + 'static) -> QueryThread {
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let space: wayfold_index::Space = SPACE.parse().expect("a space");
        let mut pool = States::new(space.clone(), 500 + seed).rows(POOL);
        for row in pool.chunks_mut(WIDTH) {
            space.canonicalize(row).expect("a state");
        }
        let thread = thread::spawn(move || {
            let (started, processor) = (Instant::now(), thread_time());
            let mut asked = 0_u64;
            'asking: loop {
                for state in pool.chunks(WIDTH) {
                    if stopped.load(Ordering::Relaxed) {
                        break 'asking;
                    }
                    assert_eq!(search(state), K as usize);
                    asked += 1;
                }
            }
            let clock = started.elapsed();
            let processor = thread_time() - processor;
            QueryRates {
                by_processor: asked as f64 / processor.as_secs_f64(),
                by_clock: asked as f64 / clock.as_secs_f64(),
            }
        });
        QueryThread { stop, thread }
    }

    fn stop(self) -> QueryRates {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().expect("the asking thread")
    }
}
