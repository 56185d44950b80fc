//! A worker's own way to the index, and the calls it makes there.

mod grpc;
mod shared;

use std::time::{Duration, Instant};

use tokio::{runtime::Runtime, sync::watch, time::timeout_at};
use wayfold::{Durability, Error, Neighbor, Space};

use super::{
    error::LoadError,
    settings::{Address, Face},
};
use crate::failure::Failure;
use grpc::GrpcTarget;
use shared::SharedTarget;

/// The content of a call.
#[derive(Debug)]
pub(super) enum Request<'a> {
    /// States to store under a tag.
    Insert { rows: &'a [f64], tag: u64 },
    /// States, and the number of neighbours of each.
    Knn { rows: &'a [f64], k: u32 },
    /// The same over one stream, with a request for each state.
    Stream { rows: &'a [f64], k: u32 },
    /// States, and the radius around each.
    Query { rows: &'a [f64], radius: f64 },
    /// Ids, each once.
    Get { ids: &'a [u64] },
}

/// The server at the other end.
#[derive(Clone, Debug)]
pub(super) struct ServerFacts {
    pub(super) version: String,
    pub(super) durability: Durability,
}

/// A connection, or a shared index. Its methods block the thread that calls them.
pub(super) trait Target: Send {
    /// The runtime of this thread.
    fn runtime(&self) -> &Runtime;

    fn space(&self) -> Space;

    /// The server's version and durability; `None` where the face does not tell them.
    fn server(&self) -> Result<Option<ServerFacts>, Error>;

    fn point_count(&self) -> Result<u64, Error>;

    /// Makes a call, once.
    fn call(&mut self, request: &Request<'_>) -> Result<(), Error>;

    /// Stores states that are no part of the measurement.
    fn store(&mut self, rows: &[f64], tag: u64) -> Result<(), Error>;

    /// The neighbours of each state.
    fn neighbors(&self, rows: &[f64], k: u32) -> Result<Vec<Vec<Neighbor>>, Error>;

    /// Up to `most` ids of stored points.
    fn ids(&self, most: usize) -> Result<Vec<u64>, Error>;

    /// Removes the points with a tag, and returns their number.
    fn remove_tagged(&self, tag: u64) -> Result<u64, Error>;

    /// Waits until the server has acknowledged all writes, and returns the number of those that it did not take.
    fn settle(&mut self) -> u64;

    /// Lets the connection live until `until` on this thread, or until `stopped`. True if `stopped`.
    fn idle(&self, until: Instant, stopped: &mut watch::Receiver<bool>) -> bool {
        let stop = stopped.wait_for(|stop| *stop);
        let ended = async { timeout_at(until.into(), stop).await };
        self.runtime().block_on(ended).is_ok()
    }
}

/// Opens a worker's own way to an index.
pub(super) fn open(
    address: &Address,
    index: &str,
    timeout: Duration,
) -> Result<Box<dyn Target>, Failure> {
    Ok(match address.face {
        Face::Grpc => Box::new(GrpcTarget::open(address, index, timeout)?),
        Face::Shared | Face::Zenoh => Box::new(SharedTarget::open(address, index, timeout)?),
    })
}

/// A runtime on the thread that calls it, for one connection or for waiting. It is dropped on a thread outside of any
/// other runtime.
fn own_runtime() -> Result<Runtime, LoadError> {
    let mut builder = tokio::runtime::Builder::new_current_thread();
    let built = builder.enable_all().build();
    built.map_err(|source| LoadError::Thread { source })
}
