//! The records of one index as a stream: first the stored ones, then each new one once it is durable.

use std::sync::Arc;

use futures_util::{StreamExt, stream};
use tokio::sync::watch;

use super::{index::Index, store::Store};
use crate::log::{LogError, Record, RecordStream};

/// The maximum bytes of stored records in one batch.
const BATCH_BYTES: usize = 1024 * 1024;

struct Follower {
    index: Arc<Index>,
    store: Arc<Store>,
    durable: watch::Receiver<Result<u64, LogError>>,
    failed: watch::Receiver<Option<LogError>>,
    after: u64,
}

/// The records of `index` after the revision `after`. The stream does not keep the store open.
pub(super) fn follow(
    index: Arc<Index>,
    store: &Arc<Store>,
    failed: watch::Receiver<Option<LogError>>,
    after: u64,
) -> RecordStream {
    let follower = Follower {
        durable: index.watch_durable(),
        index,
        store: Arc::clone(store),
        failed,
        after,
    };
    let batches = stream::unfold(Some(follower), async |follower| {
        let mut follower = follower?;
        match follower.next().await {
            Ok(records) => Some((Ok(records), Some(follower))),
            Err(error) => Some((Err(error), None)),
        }
    });
    batches.boxed()
}

impl Follower {
    /// Waits for the next records.
    async fn next(&mut self) -> Result<Vec<Arc<Record>>, LogError> {
        let after = self.after;
        let has_news = |durable: &Result<u64, LogError>| match durable {
            Ok(durable) => *durable > after,
            Err(_) => true,
        };
        let durable = tokio::select! {
            biased;
            durable = self.durable.wait_for(has_news) => {
                durable.map_err(|_| LogError::Closed)?.clone()?
            }
            failed = self.failed.wait_for(Option::is_some) => {
                let failed = failed.map_err(|_| LogError::Closed)?;
                return Err(failed.clone().unwrap_or(LogError::Closed));
            }
        };
        let records = match self.index.unapplied(after, durable) {
            Some(records) => records,
            None => self.read_stored(durable).await?,
        };
        self.after = records.last().map_or(after, |last| last.revision());
        Ok(records)
    }

    async fn read_stored(&self, durable: u64) -> Result<Vec<Arc<Record>>, LogError> {
        let (index, store, after) = (Arc::clone(&self.index), Arc::clone(&self.store), self.after);
        let read = move || index.read(&store, Some(after), BATCH_BYTES);
        let read = tokio::task::spawn_blocking(read).await;
        let mut records = read.map_err(|_| LogError::Closed)??;
        records.retain(|record| record.revision() <= durable);
        Ok(records)
    }
}
