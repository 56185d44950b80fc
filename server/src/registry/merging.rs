//! Merging in the background, so that no call pays for it.

use std::sync::{Arc, atomic::Ordering::Relaxed};

use tokio::task::JoinError;
use tracing::{debug, error};
use wayfold_index::{Merge, Merged};

use super::{Hosted, Writer};

/// A merge that ran and is not yet swapped in.
pub(super) struct FinishedMerge {
    rows: usize,
    merged: Result<Merged, JoinError>,
}

impl Hosted {
    /// Starts the merges that are due. An index runs at most as many merge tasks as all indices may run merges. Further
    /// levels wait in the forest, where they may become part of one merge instead of several.
    pub(super) fn start_merging(self: &Arc<Self>, writer: &mut Writer) {
        while writer.mergers < self.host.options.merge_threads.max(1)
            && let Some(merge) = writer.forest.begin_merge()
        {
            writer.mergers += 1;
            tokio::spawn(Arc::clone(self).merge(merge));
        }
    }

    /// Called periodically. Starts merging towards a single level if no mutation came since the previous call.
    pub(super) fn merge_if_idle(self: &Arc<Self>) {
        let revision = self.newest().revision;
        let is_pause = self.last_seen_revision.swap(revision, Relaxed) == revision;
        if is_pause && self.last_idle_revision.swap(revision, Relaxed) != revision {
            let hosted = Arc::clone(self);
            tokio::spawn(async move {
                let mut writer = hosted.write_closed().await;
                if writer.forest.revision() == revision {
                    writer.forest.pause();
                    hosted.start_merging(&mut writer);
                }
            });
        }
    }

    /// Waits for a merge permit, runs the merge on a blocking thread, and swaps it in between two mutations. It continues
    /// after the index is closed.
    async fn merge(self: Arc<Self>, merge: Merge) {
        let turn = self.host.merges.acquire().await;
        let rows = merge.rows();
        let merged = tokio::task::spawn_blocking(move || merge.run()).await;
        drop(turn);
        self.finished_merges
            .lock()
            .push(FinishedMerge { rows, merged });
        // Usually a mutation gets the writer first and has swapped the merge in by then.
        let mut writer = self.write_closed().await;
        if self.swap_in(&mut writer) {
            writer.refresh();
            self.set_head(writer.head());
        }
        self.start_merging(&mut writer);
    }

    /// Swaps in the finished merges; true if there were any. Every mutation calls this too: a merge that queued for a
    /// contended writer would come late, and searches would visit dozens of small levels meanwhile.
    pub(super) fn swap_in(&self, writer: &mut Writer) -> bool {
        let finished = std::mem::take(&mut *self.finished_merges.lock());
        let any = !finished.is_empty();
        for FinishedMerge { rows, merged } in finished {
            writer.mergers -= 1;
            match merged {
                Ok(merged) => {
                    writer.forest.finish_merge(merged);
                    debug!(index = self.name(), rows, "merged levels");
                }
                // The levels stay unmerged: answers stay exact, and searches are slower.
                Err(error) => error!(index = self.name(), rows, %error, "a merge failed"),
            }
        }
        any
    }
}
