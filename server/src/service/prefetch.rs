//! Searches of an insert before its turn to write, so that concurrent writers of one index search in parallel. With the
//! writer, the insert searches only the few points that were added meanwhile.

use wayfold_index::{Neighbor, Search};

use super::{Error, call::TimeSlicer, check::Rows};
use crate::{
    admission::AnswerBytes,
    registry::{Published, Writer},
};

/// The neighbours of rows in one revision of the index. No point is excluded, and the rows do not see each other.
pub(super) struct Prefetch {
    /// The revision that was searched.
    pub(super) revision: u64,
    /// The search for neighbours that was made.
    neighbors: Option<Search<'static>>,
    /// One a row; the last rows may be missing.
    pub(super) rows: Vec<PrefetchedRow>,
    /// The bytes of the rows.
    held: AnswerBytes,
}

/// The neighbours of one row.
pub(super) struct PrefetchedRow {
    pub(super) neighbors: Vec<Neighbor>,
    /// The nearest point within `min_separation`.
    pub(super) nearest: Vec<Neighbor>,
}

impl Prefetch {
    /// Searches `published` for `rows`; stops once it has found more than `most` neighbours.
    pub(super) async fn search(
        published: &Published,
        rows: &Rows,
        neighbors: Option<Search<'static>>,
        nearest: Option<Search<'static>>,
        most: usize,
        held: AnswerBytes,
        pace: &mut TimeSlicer,
    ) -> Result<Self, Error> {
        let bounded = |search: Search<'static>| Search {
            k: search.k.min(most + 1),
            ..search
        };
        let (neighbors, nearest) = (neighbors.map(bounded), nearest.map(bounded));
        let mut prefetch = Self {
            revision: published.revision,
            neighbors,
            rows: Vec::new(),
            held,
        };
        let mut found = 0;
        for row in rows.iter() {
            if found > most {
                break;
            }
            let search = |search: Option<Search<'_>>| -> Result<_, Error> {
                match search {
                    Some(search) => Ok(published.snapshot.search(row, &search)?.neighbors),
                    None => Ok(Vec::new()),
                }
            };
            let row_neighbors = PrefetchedRow {
                neighbors: search(neighbors)?,
                nearest: search(nearest)?,
            };
            let count = row_neighbors.neighbors.len();
            let neighbors = count + row_neighbors.nearest.len();
            let bytes = size_of::<PrefetchedRow>() + neighbors * size_of::<Neighbor>();
            prefetch.held.take(bytes)?;
            found += count;
            prefetch.rows.push(row_neighbors);
            pace.step().await?;
        }
        Ok(prefetch)
    }

    /// True if points were only added between this revision and the newest record of `writer`.
    pub(super) fn holds(&self, writer: &Writer) -> bool {
        writer.only_added_since(self.revision)
    }

    /// True if the search that was made is at least as wide as this one.
    pub(super) fn reaches(&self, search: &Search<'_>) -> bool {
        self.neighbors
            .is_some_and(|found| found.k >= search.k && found.radius >= search.radius)
    }

    /// The ids of all neighbours found.
    pub(super) fn neighbor_ids(&self) -> Vec<u64> {
        let neighbors = self.rows.iter().flat_map(|row| &row.neighbors);
        neighbors.map(|neighbor| neighbor.id).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use bytes::Bytes;
    use futures_util::poll;
    use tokio::task::yield_now;
    use wayfold_proto::v1;

    use super::*;
    use crate::{
        admission::Admission,
        config::Config,
        service::Call,
        testing::{arm, log_with, server},
    };

    /// A row has two bytes of its payload in the request, and no point is near it.
    #[tokio::test]
    async fn an_insert_that_waits_for_others_holds_what_its_rows_take() {
        const ROWS: usize = 2_000;
        let log = log_with(&arm(), &[]);
        let service = server(&log, &log);
        let hosted = service.registry().unwrap().get("arm").unwrap();
        let flow = Admission::new(&Config::default().admission, 1, 0).open();
        let call = Call {
            held: Some(Arc::new(flow.hold())),
            ..Call::default()
        };
        let states = v1::States {
            row_count: ROWS as u32,
            coordinates: (0..ROWS).map(|row| row as f64).collect(),
        };
        let insert = v1::InsertRequest {
            index_name: "arm".into(),
            states: Some(states),
            payloads: vec![Bytes::new(); ROWS],
            min_separation: 0.5,
            ..Default::default()
        };
        let writer = hosted.write().await.unwrap();
        let mut inserting = Box::pin(service.insert(&call, insert));
        let expected = ROWS * (size_of::<PrefetchedRow>() + size_of::<Bytes>());
        for _ in 0..10_000 {
            assert!(poll!(inserting.as_mut()).is_pending());
            if flow.held() >= expected {
                break;
            }
            yield_now().await;
        }
        assert!(flow.held() >= expected, "{} of {expected}", flow.held());
        drop(writer);
        inserting.await.unwrap();
        assert_eq!(flow.held(), 0);
    }
}
