//! The same search in this process: the part of an answer's time without the network.

use std::time::Duration;

use wayfold_index::{Forest, ForestOptions, Points, Search, Snapshot, Space};
use wayfold_tests::{States, figures::thread_time};

use crate::{K, SPACE, WIDTH};

/// Points that are applied at a time, as the server gets them.
const BATCH: usize = 1_000;
/// The number of query states of one measurement.
const QUERIES: usize = 5_000;

/// A forest with the same number of points as the server, merged as far as the server's forest.
pub(crate) struct InProcess {
    space: Space,
    points: Snapshot,
}

impl InProcess {
    pub(crate) fn new(points: usize) -> Self {
        let space: Space = SPACE.parse().expect("a space");
        let mut states = States::new(space.clone(), 0);
        let mut forest = Forest::new(space.clone(), ForestOptions::for_space(&space));
        let mut next_id = 0;
        while next_id < points as u64 {
            let rows = BATCH.min(points - next_id as usize);
            let mut batch = Points::new(WIDTH);
            for row in states.rows(rows).chunks_mut(WIDTH) {
                space.canonicalize(row).expect("a state");
                batch.push(next_id, 0, 0, row);
                next_id += 1;
            }
            forest
                .apply(forest.revision() + 1, &batch, &[])
                .expect("canonical states");
            while let Some(merge) = forest.begin_merge() {
                forest.finish_merge(merge.run());
            }
        }
        let points = forest.snapshot();
        Self { space, points }
    }

    /// Processor time of one search, in microseconds: the mean of thousands.
    pub(crate) fn search_us(&self, seed: u64) -> f64 {
        let mut rows = States::new(self.space.clone(), 1_000 + seed).rows(QUERIES);
        for row in rows.chunks_mut(WIDTH) {
            self.space.canonicalize(row).expect("a state");
        }
        let before = thread_time();
        for row in rows.chunks(WIDTH) {
            let answer = self
                .points
                .search(row, &Search::nearest_k(K as usize))
                .expect("canonical states");
            assert_eq!(answer.neighbors.len(), K as usize);
        }
        let taken: Duration = thread_time() - before;
        taken.as_secs_f64() * 1e6 / QUERIES as f64
    }
}
