//! Our service layer without the network.

use std::{path::Path, sync::Arc};

use wayfold_proto::v1::{
    CreateIndexRequest, InsertRequest, InsertResponse, create_index_request::SpaceForm,
};
use wayfold_server::{
    log::{Durability, FjallLog, Log},
    registry::{Registry, RegistryOptions},
    service::{Call, Limits, Service},
};
use wayfold_tests::{k_nearest, row_states};

use crate::{INDEX, SPACE, WIDTH};

/// The bytes of recent mutations that are kept. The server keeps 64 MiB unless set: a long run would fill them.
pub(crate) const WINDOW_BYTES: usize = 4 * 1024 * 1024;

/// A service in this process.
#[derive(Clone)]
pub(crate) struct LocalService(Service);

impl LocalService {
    /// Opens a service over the durable log in a directory, with the server's own settings except the window.
    pub(crate) fn open(directory: &Path, durability: Durability, window_bytes: usize) -> Self {
        let log = FjallLog::open(directory, durability).expect("a data directory");
        let options = RegistryOptions {
            window_bytes,
            ..RegistryOptions::default()
        };
        Self::over(Arc::new(log), options)
    }

    /// Opens a service over a log.
    pub(crate) fn over(log: impl Into<Log>, options: RegistryOptions) -> Self {
        let registry = Registry::new(log, options);
        registry.replay().expect("a log that is whole");
        let service = Service::new(registry, Limits::default());
        service.set_ready();
        Self(service)
    }

    /// Creates an index, unless it exists.
    pub(crate) async fn create(&self, name: &str) {
        let request = CreateIndexRequest {
            name: name.into(),
            space_form: Some(SpaceForm::SpaceText(SPACE.into())),
            ..Default::default()
        };
        let created = self.0.create_index(&Call::default(), request).await;
        created.expect("an index");
    }

    pub(crate) async fn insert(&self, request: InsertRequest) -> InsertResponse {
        let inserted = self.0.insert(&Call::default(), request).await;
        inserted.expect("an accepted insert")
    }
}

/// An insert of some states, which requests the `k` nearest of each if `k` is given.
pub(crate) fn insertion(states: &[f64], k: Option<u32>) -> InsertRequest {
    InsertRequest {
        index_name: INDEX.into(),
        states: Some(row_states(states, WIDTH)),
        neighbor_spec: k.map(k_nearest),
        ..Default::default()
    }
}
