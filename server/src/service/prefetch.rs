//! Searching for the rows of an insert before it is its turn to write, so that those who write one index search side by
//! side. What came in between is little, and is looked for when its turn has come.

use std::sync::Arc;

use wayfold_index::{Neighbor, Search};

use super::{Error, call::Pace, check::Rows};
use crate::registry::{Published, Writer};

/// What rows have around them in one revision of the index, in what the rows' searches have in common: nothing is
/// excluded, and the rows do not see each other.
pub(super) struct Prefetch {
    revision: u64,
    /// What neighbours were searched for.
    neighbors: Option<Search<'static>>,
    /// One a row, as long as there was room for them.
    rows: Vec<PrefetchedRow>,
}

/// What one row has around it.
pub(super) struct PrefetchedRow {
    pub(super) neighbors: Vec<Neighbor>,
    /// The nearest, within the separation asked for.
    pub(super) nearest: Vec<Neighbor>,
}

impl Prefetch {
    /// Searches for `rows` in `head`, until more than `most` neighbours are found.
    pub(super) async fn search(
        head: Arc<Published>,
        rows: &Rows,
        neighbors: Option<Search<'static>>,
        nearest: Option<Search<'static>>,
        most: usize,
        pace: &mut Pace,
    ) -> Result<Self, Error> {
        let bounded = |search: Search<'static>| Search {
            k: search.k.min(most + 1),
            ..search
        };
        let (neighbors, nearest) = (neighbors.map(bounded), nearest.map(bounded));
        let mut prefetch = Self {
            revision: head.revision,
            neighbors,
            rows: Vec::new(),
        };
        let mut found = 0;
        for row in rows.iter() {
            if found > most {
                break;
            }
            let search = |search: Option<Search<'_>>| -> Result<_, Error> {
                match search {
                    Some(search) => Ok(head.snapshot.search(row, &search)?.neighbors),
                    None => Ok(Vec::new()),
                }
            };
            let row_neighbors = PrefetchedRow {
                neighbors: search(neighbors)?,
                nearest: search(nearest)?,
            };
            found += row_neighbors.neighbors.len();
            prefetch.rows.push(row_neighbors);
            pace.step().await?;
        }
        Ok(prefetch)
    }

    /// Whether it is still so at the head of `writer`, but for points that were added since.
    pub(super) fn holds(&self, writer: &Writer) -> bool {
        writer.only_added_since(self.revision)
    }

    /// Whether neighbours were searched for as far as this search goes, and as many.
    pub(super) fn reaches(&self, search: &Search<'_>) -> bool {
        self.neighbors
            .is_some_and(|found| found.k >= search.k && found.radius >= search.radius)
    }

    /// The revision it is from.
    pub(super) fn revision(&self) -> u64 {
        self.revision
    }

    /// The ids of the neighbours that were found.
    pub(super) fn neighbor_ids(&self) -> Vec<u64> {
        let neighbors = self.rows.iter().flat_map(|row| &row.neighbors);
        neighbors.map(|neighbor| neighbor.id).collect()
    }

    /// What the row has around it, if it was searched for.
    pub(super) fn row(&self, at: usize) -> Option<&PrefetchedRow> {
        self.rows.get(at)
    }
}
