//! Merging in the background, so that no writer and no reader pays for it in a call of its own.

use std::sync::Arc;

use tracing::{debug, error};
use wayfold_index::Merge;

use super::{Hosted, Writer};

impl Hosted {
    /// Starts merging if a merge is due. An index has at most as many mergers as there are turns for all indices:
    /// what comes due meanwhile waits in the forest, where it may yet become part of one merge instead of many.
    pub(super) fn start_merging(self: &Arc<Self>, writer: &mut Writer) {
        while writer.mergers < self.host.options.merge_threads.max(1)
            && let Some(merge) = writer.forest.begin_merge()
        {
            writer.mergers += 1;
            tokio::spawn(Arc::clone(self).merge_all(merge));
        }
    }

    /// Merges until nothing is due. Each merge waits for its turn among those of all indices, runs on a thread for
    /// blocking work, and is swapped in between two mutations. Goes on also past the end of the index.
    async fn merge_all(self: Arc<Self>, mut merge: Merge) {
        loop {
            let turn = self.host.merges.acquire().await;
            let rows = merge.rows();
            let merged = tokio::task::spawn_blocking(move || merge.run()).await;
            drop(turn);
            let mut writer = self.write_closed().await;
            match merged {
                Ok(merged) => {
                    writer.forest.finish_merge(merged);
                    writer.refresh();
                    self.show(writer.head());
                    debug!(index = self.name(), rows, "merged levels");
                }
                // Its levels stay as they are: answers stay right, and take longer.
                Err(error) => error!(index = self.name(), rows, %error, "a merge stopped"),
            }
            match writer.forest.begin_merge() {
                Some(next) => merge = next,
                None => {
                    writer.mergers -= 1;
                    return;
                }
            }
        }
    }
}
