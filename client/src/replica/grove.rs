//! The forest that mutations are applied to, and its merges.

use tokio::task::JoinSet;
use wayfold_index::{Forest, Merged, PointRef, Points, Snapshot};

use super::load::protocol;
use crate::{Error, Mutation};

/// Most merges at once, each on a thread of its own: a long one does not keep short ones waiting.
const MERGERS: usize = 2;

/// A forest with merges in the background.
pub(super) struct Grove {
    forest: Forest,
    merges: JoinSet<Merged>,
    /// The revision when it was last looked whether anybody writes.
    looked_at: u64,
}

impl Grove {
    pub(super) fn new(forest: Forest) -> Grove {
        Grove {
            looked_at: forest.revision(),
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
            .apply(mutation.revision, &stored, &mutation.removed)
            .map_err(|error| protocol(error.to_string()))?;
        self.start_merging();
        Ok(())
    }

    /// Called now and then: if nothing was applied since the last time, merges work towards a single level.
    pub(super) fn look_for_pause(&mut self) {
        let revision = self.forest.revision();
        if std::mem::replace(&mut self.looked_at, revision) == revision {
            self.forest.pause();
            self.start_merging();
        }
    }

    fn start_merging(&mut self) {
        while self.merges.len() < MERGERS
            && let Some(merge) = self.forest.begin_merge()
        {
            self.merges.spawn_blocking(move || merge.run());
        }
    }

    /// Waits for a merge to end, for ever if there is none, and swaps it in. If it is dropped while it waits, nothing is
    /// lost.
    pub(super) async fn merged(&mut self) {
        match self.merges.join_next().await {
            Some(Ok(merged)) => self.forest.finish_merge(merged),
            // Its levels stay as they are: answers stay right, and take longer.
            Some(Err(_)) => {}
            None => std::future::pending().await,
        }
        self.start_merging();
    }
}
