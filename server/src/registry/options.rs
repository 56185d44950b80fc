//! The options of the registry.

use std::time::Duration;

use wayfold_index::{Forest, ForestOptions, Space};

use super::OperationWindow;

/// Options of the registry, for all its indices.
#[derive(Clone, Copy, Debug)]
pub struct RegistryOptions {
    /// The greatest number of points in the tree of an index that grows; None to choose it by the space.
    pub growing_rows: Option<usize>,
    /// The number of points in a leaf; None to choose it by the space.
    pub leaf_rows: Option<usize>,
    /// The greatest number of merges at once, over all indices.
    pub merge_threads: usize,
    /// The approximate bytes of newest records that each index keeps in addition to its points.
    pub window_bytes: usize,
    /// The age above which each index forgets records.
    pub window: Duration,
    /// The operations that each index remembers.
    pub operations: OperationWindow,
    /// True if the sizes of payloads are kept for their quota.
    pub counts_payloads: bool,
}

impl Default for RegistryOptions {
    fn default() -> Self {
        Self {
            growing_rows: None,
            leaf_rows: None,
            merge_threads: 2,
            window_bytes: 64 * 1024 * 1024,
            window: Duration::from_secs(3600),
            operations: OperationWindow::default(),
            counts_payloads: false,
        }
    }
}

impl RegistryOptions {
    /// An empty forest of states of `space`.
    pub(super) fn forest(&self, space: &Space) -> Forest {
        let by_space = ForestOptions::for_space(space);
        let options = ForestOptions {
            growing_rows: self.growing_rows.unwrap_or(by_space.growing_rows),
            leaf_rows: self.leaf_rows.unwrap_or(by_space.leaf_rows),
        };
        Forest::new(space.clone(), options)
    }
}
