//! The replica's forest, and its merges in the background.

use tokio::task::JoinSet;
use wayfold_index::{Forest, Merged, PointRef, Points, Snapshot};

use super::load::protocol;
use crate::{Error, Mutation};

/// The most merges at once, each on a thread of its own: a long one does not delay short ones.
const MAX_MERGES: usize = 2;

/// A forest with merges in the background.
pub(super) struct MergingForest {
    forest: Forest,
    merges: JoinSet<Merged>,
    /// The revision at the last check for a pause.
    checked_at: u64,
}

impl MergingForest {
    pub(super) fn new(forest: Forest) -> MergingForest {
        MergingForest {
            checked_at: forest.revision(),
            forest,
            merges: JoinSet::new(),
        }
    }

    pub(super) fn revision(&self) -> u64 {
        self.forest.revision()
    }

    pub(super) fn snapshot(&self) -> Snapshot {
        self.forest.snapshot()
    }

    /// Applies a mutation, whose revision is above the forest's.
    ///
    /// # Errors
    /// The server has sent points that are not of the space.
    pub(super) fn apply(&mut self, mutation: &Mutation) -> Result<(), Error> {
        let width = self.forest.space().coordinates();
        let mut stored = Points::with_capacity(width, mutation.stored.len());
        for point in mutation.stored.iter() {
            stored.push_point(PointRef {
                id: point.id,
                tag: point.tag,
                revision: point.revision,
                row: point.state,
            });
        }
        self.forest
            .apply(mutation.revision.number, &stored, &mutation.removed_ids)
            .map_err(|error| protocol(error.to_string()))?;
        self.start_merging();
        Ok(())
    }

    /// Called now and then: if nothing was applied since the last call, merges work towards a single level.
    pub(super) fn check_for_pause(&mut self) {
        let revision = self.forest.revision();
        if std::mem::replace(&mut self.checked_at, revision) == revision {
            self.forest.pause();
            self.start_merging();
        }
    }

    fn start_merging(&mut self) {
        while self.merges.len() < MAX_MERGES
            && let Some(merge) = self.forest.begin_merge()
        {
            self.merges.spawn_blocking(move || merge.run());
        }
    }

    /// Waits for a merge to end, and swaps its level in. It waits for ever if there is no merge. A future that is
    /// dropped while it waits loses nothing.
    pub(super) async fn merged(&mut self) {
        match self.merges.join_next().await {
            Some(Ok(merged)) => drop(self.forest.finish_merge(merged)),
            // Its levels stay as they are: answers stay right, but take longer.
            Some(Err(_)) => {}
            None => std::future::pending().await,
        }
        self.start_merging();
    }
}
