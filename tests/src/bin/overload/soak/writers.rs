//! Two writers, one with calls of its own and one with a shared index, and the points that the index must have then.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::mpsc::{self, RecvTimeoutError},
    thread::{self, JoinHandle},
    time::Duration,
};

use tokio::runtime::Handle;
use wayfold::{Client, Index, IndexHandle, RetryPolicy};
use wayfold_index::{Linear, Search};
use wayfold_tests::{Content, States, Stubs, bits, brute_force, knn_request, neighbor_rows};

use crate::{
    report::Figures,
    server::{INDEX, Server, WIDTH, filler, space},
};

const ROWS: usize = 20;
const PACE: Duration = Duration::from_millis(50);
/// A writer removes its oldest points beyond so many.
const KEPT: usize = 2_000;
/// The longest time that a write may take.
const PATIENCE: Duration = Duration::from_secs(120);
const SEARCHES: usize = 200;
const K: u32 = 10;

/// An index to write to.
trait Target: Send + 'static {
    fn insert(&mut self, rows: &[f64]) -> Vec<u64>;
    fn remove(&mut self, ids: &[u64]);
    /// Waits until everything is written.
    fn finish(&mut self) {}
}

/// Each write is a call, which is repeated with its operation id.
struct Calls {
    runtime: Handle,
    index: IndexHandle,
}

impl Target for Calls {
    fn insert(&mut self, rows: &[f64]) -> Vec<u64> {
        let insert = self.index.insert(rows.chunks(WIDTH));
        let inserted = self.runtime.block_on(insert.into_future());
        let outcomes = inserted.expect("an insert").outcomes;
        outcomes.iter().filter_map(|row| row.id()).collect()
    }

    fn remove(&mut self, ids: &[u64]) {
        let remove = self.index.remove(ids);
        let removed = self.runtime.block_on(remove.into_future());
        assert_eq!(removed.expect("a removal").removed_count, ids.len() as u64);
    }
}

impl Target for Index {
    fn insert(&mut self, rows: &[f64]) -> Vec<u64> {
        let ids = self.insert_many(rows.chunks(WIDTH));
        ids.expect("an insert")
    }

    fn remove(&mut self, ids: &[u64]) {
        for &id in ids {
            assert!(Index::remove(self, id).expect("a removal"), "{id}");
        }
    }

    fn finish(&mut self) {
        self.flush().expect("the pending writes");
    }
}

/// The points that a writer has stored and not removed, the oldest first.
type Kept = VecDeque<(u64, Vec<f64>)>;

pub(super) struct Writers {
    threads: Vec<(mpsc::Sender<()>, JoinHandle<Kept>)>,
}

pub(super) fn start(server: &Server) -> Writers {
    let uri = format!("http://{}", server.address);
    let runtime = Handle::current();
    let index = runtime.block_on(async {
        let builder = Client::builder().timeout(PATIENCE);
        let client = builder.retry(RetryPolicy::until_deadline());
        let client = client.connect(&uri).await.expect("a connection");
        client.index(INDEX).await.expect("the index")
    });
    let shared = Index::shared(&uri, INDEX).timeout(PATIENCE).open();
    let shared = spawn(shared.expect("a shared index"), 5);
    Writers {
        threads: vec![spawn(Calls { runtime, index }, 4), shared],
    }
}

fn spawn(mut target: impl Target, seed: u64) -> (mpsc::Sender<()>, JoinHandle<Kept>) {
    let (stop, stopped) = mpsc::channel();
    let thread = thread::spawn(move || {
        let mut states = States::new(space(), seed);
        let mut kept = Kept::new();
        while stopped.recv_timeout(PACE) == Err(RecvTimeoutError::Timeout) {
            let rows = states.rows(ROWS);
            let ids = target.insert(&rows);
            assert_eq!(ids.len(), ROWS);
            kept.extend(ids.into_iter().zip(rows.chunks(WIDTH).map(Vec::from)));
            let removed = kept.drain(..kept.len().saturating_sub(KEPT));
            let removed: Vec<u64> = removed.map(|(id, _)| id).collect();
            target.remove(&removed);
        }
        target.finish();
        kept
    });
    (stop, thread)
}

/// The points that the index must have then.
pub(super) struct Written(Vec<Kept>);

impl Writers {
    /// Ends both, with everything written.
    pub(super) fn finish(self) -> Written {
        let ended = self.threads.into_iter().map(|(stop, thread)| {
            drop(stop);
            thread.join().expect("a writer")
        });
        Written(ended.collect())
    }
}

impl Written {
    /// Compares the index with `points` points of the setup and those of the writers, and its answers with brute force.
    /// The figures, and the number of those that are wrong.
    pub(super) fn compare(&self, server: &Server, points: usize) -> (Figures, usize) {
        let runtime = Handle::current();
        let (content, answers, queries) = runtime.block_on(async {
            let mut stubs = Stubs::connect(&format!("http://{}", server.address)).await;
            let content = Content::read(&stubs, INDEX).await.expect("a scan");
            let queries = States::new(space(), 6).rows(SEARCHES);
            let request = knn_request(INDEX, &queries, WIDTH, K);
            let answer = stubs.points.knn(request).await.expect("an answer");
            let neighbors = answer.into_inner().neighbors.unwrap_or_default();
            (content, neighbor_rows(&neighbors), queries)
        });
        let mut figures = Figures::default();
        let mut linear = Linear::new(space());
        let mut expected: BTreeMap<u64, Vec<u64>> = BTreeMap::new();
        for (id, row) in self.0.iter().flatten() {
            expected.insert(*id, canonical(row));
            brute_force::store(&mut linear, &[*id], row, 0, 1);
        }
        let written = expected.len();
        figures.add("points of the writers", written as f64);
        let filler = filler(points);
        let others = content
            .points
            .keys()
            .filter(|id| !expected.contains_key(id));
        let others: Vec<u64> = others.copied().collect();
        let too_many = others.len().abs_diff(points);
        for (id, row) in others.iter().zip(filler.chunks(WIDTH)) {
            expected.insert(*id, canonical(row));
            brute_force::store(&mut linear, &[*id], row, 0, 1);
        }
        let is_wrong = |(id, state): &(&u64, &Vec<u64>)| {
            content.points.get(id).map(|point| &point.state) != Some(state)
        };
        let wrong = expected.iter().filter(is_wrong).count();
        let search = Search::nearest_k(K as usize);
        let misses = queries
            .chunks(WIDTH)
            .zip(&answers)
            .filter(|(state, answer)| {
                let answer = answer.iter().map(|(id, d)| (*id, d.to_bits()));
                let answer: Vec<_> = answer.collect();
                brute_force::search(&linear, state, &search) != answer
            });
        let misses = misses.count() + SEARCHES.abs_diff(answers.len());
        figures.add("points too few or too many", too_many as f64);
        figures.add("points lost or changed", wrong as f64);
        figures.add("searches unlike brute force", misses as f64);
        (figures, too_many + wrong + misses)
    }
}

/// The bits of a state as an index stores it.
fn canonical(row: &[f64]) -> Vec<u64> {
    let mut row = row.to_vec();
    space().canonicalize(&mut row).expect("a state");
    bits(&row)
}
