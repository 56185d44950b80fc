//! The server of a run, and indices on it that last as long as the run.

use std::rc::Rc;

use tokio::runtime::{Builder, Runtime};
use wayfold::{Client, Index, Space};

use super::{error::PlanningError, options::Source, server::ServerProcess};

/// A server that runs already, or one that ends with this value.
#[derive(Clone)]
pub struct Host(Rc<Connection>);

struct Connection {
    uri: String,
    client: Client,
    /// The thread that calls makes them itself.
    runtime: Runtime,
    _process: Option<ServerProcess>,
}

impl Host {
    /// The server at `uri`, or a new one. It must answer now, so that no earlier work is wasted if it does not.
    pub fn new(uri: Option<&str>) -> Result<Host, PlanningError> {
        let process = match uri {
            Some(_) => None,
            None => Some(ServerProcess::start()?),
        };
        let own = process.as_ref().map(ServerProcess::uri);
        let uri = uri.or(own).unwrap_or_default().to_owned();
        let runtime = Builder::new_current_thread().enable_all().build();
        let runtime = runtime.map_err(PlanningError::Threads)?;
        let client = runtime.block_on(Client::connect(&uri))?;
        Ok(Host(Rc::new(Connection {
            uri,
            client,
            runtime,
            _process: process,
        })))
    }

    /// Its address.
    pub fn uri(&self) -> &str {
        &self.0.uri
    }

    /// Waits for calls.
    pub fn block_on<T>(&self, calls: impl Future<Output = T>) -> T {
        self.0.runtime.block_on(calls)
    }

    /// A name for an index that no other has.
    pub fn temporary(&self) -> Temporary {
        Temporary {
            host: self.clone(),
            name: format!("planning-{}", uuid::Uuid::new_v4()),
        }
    }
}

/// An index of this planner's own, deleted when this value is dropped.
pub struct Temporary {
    host: Host,
    name: String,
}

impl Temporary {
    /// Creates the index and opens it.
    pub fn create(&self, source: Source, space: &Space) -> Result<Index, PlanningError> {
        let uri = self.host.uri();
        Ok(match source {
            Source::Remote => Index::remote(uri, &self.name).create(space).open()?,
            _ => Index::shared(uri, &self.name).create(space).open()?,
        })
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        let server = &self.host.0;
        // If the server is gone, its indices are gone too.
        let deleted = server.client.delete_index(&self.name);
        let _ = self.host.block_on(deleted.into_future());
    }
}
