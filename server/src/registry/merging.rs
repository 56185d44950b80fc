//! Merges in the background, so that no call waits for a merge.

use std::sync::{Arc, atomic::Ordering::Relaxed};

use tracing::{debug, error};
use wayfold_index::{Merge, Space};

use super::{Host, Hosted, Published, apply::AppliedForest, loading::point_bytes};
use crate::watermark::release_if_grown;

impl Host {
    /// The greatest number of points that a merge may copy in its share of the memory that is left, above the
    /// watermarks too: the old levels, their points as rows and the new level exist at a time.
    pub(super) fn merge_rows(&self, space: &Space) -> usize {
        let memory = self.watermarks.memory.as_ref();
        let left = memory.and_then(|it| it.remaining());
        let bytes = 3 * point_bytes(space) * self.options.merge_threads.max(1);
        let rows = left.map_or(u64::MAX, |left| left / bytes as u64);
        usize::try_from(rows).unwrap_or(usize::MAX)
    }
}

impl Hosted {
    /// Starts the merges that are due. An index runs at most as many merge tasks as all indices may run merges. Further
    /// levels wait in the forest, where they may become part of one merge instead of several. So do those whose merge
    /// would take more memory than is left.
    pub(super) fn start_merging(self: &Arc<Self>, applied: &mut AppliedForest) {
        while applied.mergers < self.host.options.merge_threads.max(1)
            && let rows = self.host.merge_rows(self.space())
            && let Some(merge) = applied.forest.begin_merge_up_to(rows)
        {
            applied.mergers += 1;
            tokio::spawn(Arc::clone(self).merge(merge));
        }
    }

    /// Called periodically. If no mutation came since the previous call, releases memory of former revisions and starts
    /// merging towards a single level.
    pub(super) fn merge_if_idle(self: &Arc<Self>) {
        let revision = self.published().revision;
        let is_pause = self.last_seen_revision.swap(revision, Relaxed) == revision;
        if is_pause {
            self.release_former_state();
        }
        if is_pause && self.last_idle_revision.swap(revision, Relaxed) != revision {
            let hosted = Arc::clone(self);
            tokio::spawn(async move {
                let mut applied = hosted.applied.lock().await;
                if applied.forest.revision() == revision {
                    applied.forest.pause();
                    hosted.start_merging(&mut applied);
                }
            });
        }
    }

    /// Waits for a merge permit, runs the merge on a blocking thread, swaps it in between two mutations, and gives the memory
    /// back. It continues after the index is closed.
    async fn merge(self: Arc<Self>, merge: Merge) {
        let turn = self.host.merges.acquire().await;
        let rows = merge.rows();
        let merged = tokio::task::spawn_blocking(move || merge.run()).await;
        drop(turn);
        // The apply loop waits for the forest in turn: a merge waits for one batch of records at most.
        let mut applied = self.applied.lock().await;
        applied.mergers -= 1;
        let published = self.published();
        match merged {
            Ok(merged) => {
                applied.forest.finish_merge(merged);
                debug!(index = self.name(), rows, "merged levels");
                // A failure within a batch leaves the forest ahead of what is published.
                if applied.forest.revision() == published.revision {
                    self.publish(&Arc::new(Published {
                        snapshot: applied.forest.snapshot(),
                        revision: published.revision,
                        view: Arc::clone(&published.view),
                        is_shared: published.is_shared,
                    }));
                }
            }
            // The levels stay unmerged: answers stay exact, and searches are slower.
            Err(error) => error!(index = self.name(), rows, %error, "a merge failed"),
        }
        self.start_merging(&mut applied);
        drop(applied);
        // The former publication holds the merged levels, and a search may hold them for longer.
        tokio::task::spawn_blocking(move || {
            drop(published);
            release_if_grown();
        });
    }
}
