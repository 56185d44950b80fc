//! The log of a server: opened and replayed at its start, and closed at its end, also if it ends before it serves.

use std::{mem, sync::Arc};

use parking_lot::Mutex;
use tracing::error;

use super::ServerError;
use crate::{
    config::DataConfig,
    log::{
        Catalogue, FjallLog, Journal, Log, MemoryLog, NatsError, NatsOptions, PointStore,
        StoreOptions, connect_nats,
    },
    registry::{Registry, RegistryOptions},
    watermark::Watermarks,
};

/// The store on disk, once it is open. Clones share it.
#[derive(Clone, Default)]
pub(super) struct OpenedStore(Arc<Mutex<Stage>>);

#[derive(Default)]
enum Stage {
    #[default]
    Waiting,
    Open(Arc<FjallLog>),
    Closed,
}

impl OpenedStore {
    /// Opens the log and replays it into a registry, on a blocking thread. Returns the connection to NATS if the journal
    /// is there.
    pub(super) async fn open_registry(
        self,
        options: RegistryOptions,
        (data, cluster): (DataConfig, Option<NatsOptions>),
        watermarks: Watermarks,
    ) -> Result<(Registry, Option<async_nats::Client>), ServerError> {
        let open = move || {
            let (log, nats) = match data.directory() {
                Some(directory) => {
                    let memory = watermarks.memory.as_ref().and_then(|memory| memory.limit());
                    let options = StoreOptions {
                        durability: data.durability,
                        memory: memory.unwrap_or(u64::MAX),
                        is_copy: cluster.is_some(),
                    };
                    // A server that stops meanwhile waits for this lock, and then closes the store.
                    let mut stage = self.0.lock();
                    if matches!(*stage, Stage::Closed) {
                        return Err(ServerError::Ended);
                    }
                    let local = Arc::new(FjallLog::open(directory, options)?);
                    *stage = Stage::Open(Arc::clone(&local));
                    drop(stage);
                    log_over(local, cluster.as_ref())?
                }
                None => log_over(Arc::new(MemoryLog::new()), cluster.as_ref())?,
            };
            let registry = Registry::with_watermarks(log, options, watermarks);
            registry.replay()?;
            Ok((registry, nats))
        };
        // The join fails only if the task panicked.
        let opened = tokio::task::spawn_blocking(open).await;
        opened.unwrap_or(Err(ServerError::Ended))
    }

    /// Closes the store, which does not open any more. The pages and calls that were cut may hold it for longer than the process lives.
    pub(super) async fn close(self) {
        let close = move || {
            if let Stage::Open(store) = mem::replace(&mut *self.0.lock(), Stage::Closed) {
                store.close();
            }
        };
        if let Err(error) = tokio::task::spawn_blocking(close).await {
            error!(%error, "the store was not closed in order");
        }
    }
}

/// The log over the engine of this server: the engine itself, or its points under the journal of a cluster.
fn log_over<Engine>(
    local: Arc<Engine>,
    cluster: Option<&NatsOptions>,
) -> Result<(Log, Option<async_nats::Client>), NatsError>
where
    Engine: Journal + PointStore + Catalogue + 'static,
{
    match cluster {
        None => Ok((Log::from(local), None)),
        Some(options) => connect_nats(options, local).map(|(log, nats)| (log, Some(nats))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::log::Durability;

    #[tokio::test]
    async fn a_closed_store_does_not_open() {
        let directory = tempfile::tempdir().unwrap();
        let data = DataConfig {
            dir: directory.path().to_str().unwrap().into(),
            durability: Durability::Fsync,
        };
        let store = OpenedStore::default();
        store.clone().close().await;
        let opened = store.open_registry(
            RegistryOptions::default(),
            (data, None),
            Watermarks::default(),
        );
        assert!(matches!(opened.await, Err(ServerError::Ended)));
        assert_eq!(directory.path().read_dir().unwrap().count(), 0);
    }
}
