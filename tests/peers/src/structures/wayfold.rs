//! Our index: the forest while it grows, and at rest.

use wayfold_index::{Answer, Forest, ForestOptions, Points, Search, Space};

use super::Structure;
use crate::data::Rows;

/// The forest.
pub struct Wayfold(Forest);

impl Wayfold {
    /// It grows by single inserts, each a separate mutation. Merges run when they fall due.
    pub fn growing(space: &Space) -> Self {
        Wayfold(Forest::new(space.clone(), ForestOptions::for_space(space)))
    }

    /// It is one tree, the final state of merging.
    pub fn resting(space: &Space, rows: &Rows) -> Self {
        let Wayfold(mut forest) = Wayfold::growing(space);
        forest
            .apply(1, &points(space, rows), &[])
            .expect("canonical states");
        forest.settle();
        Wayfold(forest)
    }

    fn search(&self, query: &[f64], search: &Search<'_>, found: &mut Vec<u32>) {
        let answer = self.0.search(query, search);
        report(&answer.expect("canonical states"), found);
    }
}

/// The rows under their ids.
pub fn points(space: &Space, rows: &Rows) -> Points {
    let mut points = Points::with_capacity(space.coordinates(), rows.len());
    for (id, row) in rows.iter().enumerate() {
        points.push(id as u64, 0, 1, row);
    }
    points
}

pub fn report(answer: &Answer, found: &mut Vec<u32>) {
    found.clear();
    found.extend(answer.neighbors.iter().map(|neighbor| neighbor.id as u32));
}

impl Structure for Wayfold {
    fn nearest(&mut self, query: &[f64], k: usize, found: &mut Vec<u32>) {
        self.search(query, &Search::nearest_k(k), found);
    }

    fn within(&mut self, query: &[f64], radius: f64, found: &mut Vec<u32>) {
        self.search(query, &Search::nearest_r(radius), found);
    }

    fn insert(&mut self, row: &[f64]) {
        let id = self.0.revision();
        let mut point = Points::with_capacity(row.len(), 1);
        point.push(id, 0, id + 1, row);
        self.0.apply(id + 1, &point, &[]).expect("canonical states");
        self.0.settle();
    }
}
