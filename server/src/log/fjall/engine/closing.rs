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
        if let Err(error) = &synced {
            warn!(
                %error,
                "could not sync the log; the next start takes mutations for lost"
            );
        }
        self.sweeper.stop();
        let closed = self.store.close();
        for index in self.indexes.read().values() {
            index.close(LogError::Closed);
        }
        save_manifest(&self.directory);
        if synced.is_ok() && self.failure.get().is_none() {
            let marked = closed.and_then(|()| journal::mark_synced(&self.directory).map_err(shut));
            // Without the marker the next start rewrites the journal.
            if let Err(error) = marked {
                debug!(%error, "cannot mark the journal as synced");
            }
        }
    }

    /// Syncs everything and writes the sync marks.
    fn sync_all(&self) -> Result<(), LogError> {
        StoreJournal::new(Arc::clone(&self.store), self.directory.join(STORE)).sync()?;
        let indexes: Vec<_> = self.indexes.read().values().cloned().collect();
        let marked = Marks::open(&self.directory.join(MARKS))
            .and_then(|(mut marks, _)| write_marks(&mut marks, &indexes))
            .and_then(|()| unclean_marker::end(self.directory.path()));
        marked.map_err(shut)
    }
}
