//! The log of a server: opened and replayed at its start, and closed at its end, also if it ends before it serves.

use std::{mem, sync::Arc};

use parking_lot::Mutex;
use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;
use tracing::error;

use super::ServerError;
use crate::{
    config::DataConfig,
    log::{
        Catalogue, FjallLog, Journal, Log, MemoryLog, NatsOptions, PointStore, StoreOptions,
        open_nats,
    },
    registry::{Registry, RegistryOptions},
    watermark::Watermarks,
};

/// The life of the store on disk, which a server in memory never opens. Clones share it.
#[derive(Clone, Default)]
pub(super) struct StoreLifetime {
    stage: Arc<Mutex<Stage>>,
    /// Cancelled by [`StoreLifetime::close`].
    closing: CancellationToken,
}

#[derive(Default)]
enum Stage {
    #[default]
    Waiting,
    Open(Arc<FjallLog>),
    Closed,
}

impl StoreLifetime {
    /// Opens the log and replays it into a registry, on a blocking thread. Returns the connection to NATS if the journal
    /// is there.
    pub(super) async fn open_registry(
        self,
        options: RegistryOptions,
        data: DataConfig,
        cluster: Option<NatsOptions>,
        watermarks: Watermarks,
    ) -> Result<(Registry, Option<async_nats::Client>), ServerError> {
        let open = move || {
            // A server that stops meanwhile waits for this lock: the runtime must outlive the connecting.
            let mut stage = self.stage.lock();
            if matches!(*stage, Stage::Closed) {
                return Err(ServerError::Ended);
            }
            let (log, nats) = match data.directory() {
                Some(directory) => {
                    let memory = watermarks.memory.as_ref().and_then(|memory| memory.limit());
                    let options = StoreOptions {
                        durability: data.durability,
                        memory: memory.unwrap_or(u64::MAX),
                        is_copy: cluster.is_some(),
                    };
                    let local = Arc::new(FjallLog::open(directory, options)?);
                    *stage = Stage::Open(Arc::clone(&local));
                    self.log_over(local, cluster.as_ref())?
                }
                None => self.log_over(Arc::new(MemoryLog::new()), cluster.as_ref())?,
            };
            drop(stage);
            let registry = Registry::with_watermarks(log, options, watermarks);
            registry.replay()?;
            Ok((registry, nats))
        };
        // The join fails only if the task panicked.
        let opened = tokio::task::spawn_blocking(open).await;
        opened.unwrap_or(Err(ServerError::Ended))
    }

    /// Closes the store for good, without waiting for the pages and cut calls that may hold it until the process ends.
    pub(super) async fn close(self) {
        self.closing.cancel();
        let close = move || {
            if let Stage::Open(store) = mem::replace(&mut *self.stage.lock(), Stage::Closed) {
                store.close();
            }
        };
        if let Err(error) = tokio::task::spawn_blocking(close).await {
            error!(%error, "the store was not closed in order");
        }
    }

    /// The log over the engine of this server: the engine itself, or its points under the journal of a cluster. The wait for
    /// NATS ends with [`StoreLifetime::close`].
    fn log_over<Engine>(
        &self,
        local: Arc<Engine>,
        cluster: Option<&NatsOptions>,
    ) -> Result<(Log, Option<async_nats::Client>), ServerError>
    where
        Engine: Journal + PointStore + Catalogue + 'static,
    {
        let Some(options) = cluster else {
            return Ok((Log::from(local), None));
        };
        let opening = self.closing.run_until_cancelled(open_nats(options, local));
        let opened = Handle::current().block_on(opening);
        let (log, nats) = opened.ok_or(ServerError::Ended)??;
        Ok((log, Some(nats)))
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
        let store = StoreLifetime::default();
        store.clone().close().await;
        let opened = store.open_registry(
            RegistryOptions::default(),
            data,
            None,
            Watermarks::default(),
        );
        assert!(matches!(opened.await, Err(ServerError::Ended)));
        assert_eq!(directory.path().read_dir().unwrap().count(), 0);
    }
}
