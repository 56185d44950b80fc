//! The cover tree of the crate smartcore, which is static and works in any metric.
//!
//! It is the only one in a maintained package of crates.io or Debian. It is part of a machine learning library, and not
//! tuned like the paper's.

use smartcore::{algorithm::neighbour::cover_tree::CoverTree, metrics::distance::Distance};
use wayfold_index::Space;

use super::Structure;
use crate::data::Rows;

#[derive(Clone, Debug)]
struct Metric(Space);

impl Distance<Vec<f64>> for Metric {
    fn distance(&self, a: &Vec<f64>, b: &Vec<f64>) -> f64 {
        self.0.distance(a, b)
    }
}

/// The tree, and a buffer for a query in its form.
pub struct Cover {
    tree: CoverTree<Vec<f64>, Metric>,
    query: Vec<f64>,
}

impl Cover {
    pub fn new(space: &Space, rows: &Rows) -> Self {
        let rows = rows.iter().map(<[f64]>::to_vec).collect();
        Cover {
            tree: CoverTree::new(rows, Metric(space.clone())).expect("a tree of any points"),
            query: Vec::new(),
        }
    }

    fn ask(&mut self, query: &[f64]) {
        self.query.clear();
        self.query.extend_from_slice(query);
    }
}

impl Structure for Cover {
    fn nearest(&mut self, query: &[f64], k: usize, found: &mut Vec<u32>) {
        self.ask(query);
        let near = self.tree.find(&self.query, k);
        let near = near.expect("fewer are asked for than there are");
        found.clear();
        found.extend(near.iter().map(|(id, _, _)| *id as u32));
    }

    fn within(&mut self, query: &[f64], radius: f64, found: &mut Vec<u32>) {
        self.ask(query);
        let near = self.tree.find_radius(&self.query, radius);
        let near = near.expect("a radius above 0");
        found.clear();
        found.extend(near.iter().map(|(id, _, _)| *id as u32));
    }

    fn insert(&mut self, _: &[f64]) {
        unreachable!("it is static");
    }
}
