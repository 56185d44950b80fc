//! The end of an open store: its last sync, its marks and its threads.

use std::sync::Arc;

use tracing::{debug, warn};

use super::{Engine, save_manifest, write_marks};
use crate::log::{
    LogError,
    fjall::{
        MARKS, STORE,
        journal::{self, StoreJournal},
        store::shut,
        sync_marks::Marks,
        unclean_marker,
    },
};

impl Engine {
    /// Syncs all appended records, ends the threads, and closes the store even while views of it are held.
    pub(in crate::log::fjall) fn shut(&self) {
        let synced = match &self.syncer {
            Some(syncer) => {
                syncer.stop();
                Ok(())
            }
            None => self.sync_all(),
        };
        self.sweeper.stop();
        // A mutation may have been acknowledged since the last sync, and the store syncs once more.
        let synced = synced.and(self.store.close());
        for index in self.indexes.read().values() {
            index.close(LogError::Closed);
        }
        save_manifest(&self.directory);
        if self.syncer.is_none() {
            let end = || unclean_marker::end(self.directory.path()).map_err(shut);
            if let Err(error) = synced.clone().and_then(|()| end()) {
                warn!(
                    %error,
                    "could not sync the log; the next start takes mutations for lost"
                );
            }
        }
        // Without the marker the next start rewrites the journal.
        if synced.is_ok()
            && self.failure.get().is_none()
            && let Err(error) = journal::mark_synced(&self.directory)
        {
            debug!(%error, "cannot mark the journal as synced");
        }
    }

    /// Syncs everything and writes the sync marks.
    fn sync_all(&self) -> Result<(), LogError> {
        StoreJournal::new(Arc::clone(&self.store), self.directory.join(STORE)).sync()?;
        let indexes: Vec<_> = self.indexes.read().values().cloned().collect();
        let marks = Marks::open(&self.directory.join(MARKS));
        let marked = marks.and_then(|(mut marks, _)| write_marks(&mut marks, &indexes));
        marked.map_err(shut)
    }
}
