//! Merging in the background, so that no writer and no reader pays for it in a call of its own.

use std::sync::{Arc, atomic::Ordering::Relaxed};

use tokio::task::JoinError;
use tracing::{debug, error};
use wayfold_index::{Merge, Merged};

use super::{Hosted, Writer};

/// What has become of a merge.
pub(super) struct FinishedMerge {
    rows: usize,
    merged: Result<Merged, JoinError>,
}

impl Hosted {
    /// Starts merging if a merge is due. An index has at most as many mergers as there are turns for all indices:
    /// what comes due meanwhile waits in the forest, where it may yet become part of one merge instead of many.
    pub(super) fn start_merging(self: &Arc<Self>, writer: &mut Writer) {
        while writer.mergers < self.host.options.merge_threads.max(1)
            && let Some(merge) = writer.forest.begin_merge()
        {
            writer.mergers += 1;
            tokio::spawn(Arc::clone(self).merge(merge));
        }
    }

    /// Called now and then: if there was no mutation since the last time, merges work towards a single level.
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

    /// Runs a merge, when it is its turn among those of all indices, on a thread for blocking work, and sees to it that
    /// it is swapped in between two mutations. Goes on also past the end of the index.
    async fn merge(self: Arc<Self>, merge: Merge) {
        let turn = self.host.merges.acquire().await;
        let rows = merge.rows();
        let merged = tokio::task::spawn_blocking(move || merge.run()).await;
        drop(turn);
        self.finished_merges
            .lock()
            .push(FinishedMerge { rows, merged });
        // Most often a mutation has the writer before, and has swapped it in by then.
        let mut writer = self.write_closed().await;
        if self.swap_in(&mut writer) {
            writer.refresh();
            self.set_head(writer.head());
        }
        self.start_merging(&mut writer);
    }

    /// Swaps in the merges that have run; whether there were any. Who writes does so, too: where many wait for the writer,
    /// a merge that waited behind them all would come late, and searches would visit small levels by the dozen.
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
                // Its levels stay as they are: answers stay right, and take longer.
                Err(error) => error!(index = self.name(), rows, %error, "a merge stopped"),
            }
        }
        any
    }
}
