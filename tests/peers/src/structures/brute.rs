//! Brute force as the paper means it: every point's distance, one after the other.

use wayfold_index::{Linear, PointRef, Search, Space};

use super::Structure;

/// The index's own table, which measures with the space's distance alone.
pub struct Brute(Linear);

impl Brute {
    pub fn new(space: &Space) -> Self {
        Brute(Linear::new(space.clone()))
    }

    fn search(&self, query: &[f64], search: &Search<'_>, found: &mut Vec<u32>) {
        found.clear();
        let answer = self.0.search(query, search);
        found.extend(answer.neighbors.iter().map(|neighbor| neighbor.id as u32));
    }
}

impl Structure for Brute {
    fn nearest(&mut self, query: &[f64], k: usize, found: &mut Vec<u32>) {
        self.search(query, &Search::nearest_k(k), found);
    }

    fn within(&mut self, query: &[f64], radius: f64, found: &mut Vec<u32>) {
        self.search(query, &Search::nearest_r(radius), found);
    }

    fn insert(&mut self, row: &[f64]) {
        let id = self.0.len() as u64;
        self.0.insert(PointRef {
            id,
            tag: 0,
            revision: 1,
            row,
        });
    }
}
