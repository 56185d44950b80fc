//! Brute force in the paper's sense: it computes the distance of every point, one after the other, and keeps the
//! nearest.

use wayfold_index::Space;

use super::Structure;

/// Rows, compared by the space's scalar distance, which interprets the space at run time. A loop compiled for one space
/// is faster.
pub struct Brute {
    space: Space,
    rows: Vec<f64>,
    /// The nearest so far, in order.
    nearest: Vec<(f64, u32)>,
}

impl Brute {
    pub fn new(space: &Space) -> Self {
        Brute {
            space: space.clone(),
            rows: Vec::new(),
            nearest: Vec::new(),
        }
    }
}

impl Structure for Brute {
    fn nearest(&mut self, query: &[f64], k: usize, found: &mut Vec<u32>) {
        self.nearest.clear();
        let mut worst = f64::INFINITY;
        let rows = self.rows.chunks_exact(self.space.coordinates());
        for (row, id) in rows.zip(0..) {
            let distance = self.space.distance(query, row);
            if distance >= worst {
                continue;
            }
            let place = self.nearest.partition_point(|held| held.0 <= distance);
            self.nearest.truncate(k - 1);
            self.nearest.insert(place, (distance, id));
            if self.nearest.len() == k {
                worst = self.nearest[k - 1].0;
            }
        }
        found.clear();
        found.extend(self.nearest.iter().map(|held| held.1));
    }

    fn within(&mut self, query: &[f64], radius: f64, found: &mut Vec<u32>) {
        found.clear();
        let rows = self.rows.chunks_exact(self.space.coordinates());
        for (row, id) in rows.zip(0..) {
            if self.space.distance(query, row) <= radius {
                found.push(id);
            }
        }
    }

    fn insert(&mut self, row: &[f64]) {
        self.rows.extend_from_slice(row);
    }
}
