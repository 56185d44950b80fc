//! The records of one index as a stream: first the stored ones, then each new one once it is durable.

use std::sync::Arc;

use tokio::sync::watch;

use super::{index::Index, store::Store};
use crate::log::{LogError, RecordStream, following};

/// The maximum bytes of stored records in one batch.
const BATCH_BYTES: usize = 1024 * 1024;

/// The records of `index` after the revision `after`. The stream does not keep the store open.
pub(super) fn follow(
    index: Arc<Index>,
    store: &Arc<Store>,
    mut failed: watch::Receiver<Option<LogError>>,
    after: u64,
) -> RecordStream {
    let durable = index.watch_durable();
    let failure = async move {
        let failed = failed.wait_for(Option::is_some).await;
        let failed = failed.ok().and_then(|failed| failed.clone());
        failed.unwrap_or(LogError::Closed)
    };
    let store = Arc::clone(store);
    following::follow(durable, failure, after, move |after, durable| {
        let (index, store) = (Arc::clone(&index), Arc::clone(&store));
        async move {
            if let Some(records) = index.unapplied(after, durable) {
                return Ok(records);
            }
            let read = move || index.read(&store, Some(after), BATCH_BYTES);
            let read = tokio::task::spawn_blocking(read).await;
            let mut records = read.map_err(|_| LogError::Closed)??;
            records.retain(|record| record.revision() <= durable);
            Ok(records)
        }
    })
}
