//! An index that grows by batches while a reader queries without pause.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use indicatif::ProgressBar;
use wayfold_proto::v1::InsertRequest;
use wayfold_tests::{States, Stubs, row_states};

use crate::{
    INDEX, SPACE, WIDTH,
    searcher::{CallPattern, Searcher},
};

const BATCH: usize = 1_000;

/// The cost of growing.
#[derive(Clone, Debug)]
pub(crate) struct Growth {
    /// Points per second, while the reader reads.
    pub(crate) inserts_per_second: f64,
    /// The durations of the calls, ascending.
    pub(crate) inserts: Vec<Duration>,
    /// The durations of the reader's calls, ascending.
    pub(crate) queries: Vec<Duration>,
}

/// Inserts `points` points with one call in flight. A reader has one call in flight meanwhile.
pub(crate) async fn grow(stubs: &Stubs, points: usize, progress: &ProgressBar) -> Growth {
    let grown = Arc::new(AtomicBool::new(false));
    let (reading, mut reader) = (stubs.clone(), Searcher::new(CallPattern::OneInFlight, 1));
    let done = grown.clone();
    let reader = tokio::spawn(async move {
        let mut stubs = reading;
        let mut taken = Vec::new();
        while !done.load(Ordering::Relaxed) {
            let request = reader.request(1);
            let called = Instant::now();
            stubs.points.knn(request).await.expect("an answer");
            taken.push(called.elapsed());
        }
        taken
    });

    let mut stubs = stubs.clone();
    let mut states = States::new(SPACE.parse().expect("a space"), 0);
    let mut inserts = Vec::with_capacity(points / BATCH + 1);
    let mut inserted = 0;
    while inserted < points {
        let rows = BATCH.min(points - inserted);
        let request = InsertRequest {
            index_name: INDEX.into(),
            states: Some(row_states(&states.rows(rows), WIDTH)),
            ..Default::default()
        };
        let called = Instant::now();
        let response = stubs.insert(request).await;
        inserts.push(called.elapsed());
        assert_eq!(response.ids.len(), rows);
        inserted += rows;
        progress.inc(rows as u64);
    }
    grown.store(true, Ordering::Relaxed);
    let mut queries = reader.await.expect("the reader");
    // Drawing the states is not the server's work.
    let in_calls: Duration = inserts.iter().sum();
    inserts.sort();
    queries.sort();
    Growth {
        inserts_per_second: inserted as f64 / in_calls.as_secs_f64(),
        inserts,
        queries,
    }
}
