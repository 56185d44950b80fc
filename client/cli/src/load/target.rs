//! A worker's own way to the index, and the calls it makes there.

mod grpc;
mod shared;

use std::time::Duration;

use wayfold::{Durability, Error, Filter, Neighbor, Space};

use super::{
    error::LoadError,
    mix::Verb,
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
    /// States, and the radius around each.
    Query { rows: &'a [f64], radius: f64 },
    /// Ids, each once.
    Get { ids: &'a [u64] },
}

impl Request<'_> {
    pub(super) fn verb(&self) -> Verb {
        match self {
            Request::Insert { .. } => Verb::Insert,
            Request::Knn { .. } => Verb::Knn,
            Request::Query { .. } => Verb::Query,
            Request::Get { .. } => Verb::Get,
        }
    }

    /// The number of its states of `width` coordinates, or of its ids.
    pub(super) fn rows(&self, width: usize) -> usize {
        match self {
            Request::Insert { rows, .. }
            | Request::Knn { rows, .. }
            | Request::Query { rows, .. } => rows.len() / width,
            Request::Get { ids } => ids.len(),
        }
    }
}

/// A connection, or a shared index. Its methods block the thread that calls them.
pub(super) enum Target {
    Grpc(GrpcTarget),
    Shared(SharedTarget),
}

/// The server at the other end.
#[derive(Clone, Debug)]
pub(super) struct ServerFacts {
    pub(super) version: String,
    pub(super) durability: Durability,
}

impl Target {
    pub(super) fn open(
        address: &Address,
        index: &str,
        timeout: Duration,
    ) -> Result<Target, Failure> {
        Ok(match address.face {
            Face::Grpc => Target::Grpc(GrpcTarget::open(address, index, timeout)?),
            Face::Shared | Face::Zenoh => {
                Target::Shared(SharedTarget::open(address, index, timeout)?)
            }
        })
    }

    pub(super) fn space(&self) -> Space {
        match self {
            Target::Grpc(target) => target.space(),
            Target::Shared(target) => target.space(),
        }
    }

    /// The server's version and durability; `None` where the face does not tell them.
    pub(super) fn server(&self) -> Result<Option<ServerFacts>, Error> {
        match self {
            Target::Grpc(target) => target.server().map(Some),
            Target::Shared(_) => Ok(None),
        }
    }

    pub(super) fn point_count(&self) -> Result<u64, Error> {
        match self {
            Target::Grpc(target) => target.point_count(),
            Target::Shared(target) => target.point_count(),
        }
    }

    /// Makes a call, once.
    pub(super) fn call(&mut self, request: &Request<'_>) -> Result<(), Error> {
        match self {
            Target::Grpc(target) => target.call(request),
            Target::Shared(target) => target.call(request),
        }
    }

    /// Stores states that are no part of the measurement.
    pub(super) fn store(&mut self, rows: &[f64], tag: u64) -> Result<(), Error> {
        match self {
            Target::Grpc(target) => target.store(rows, tag),
            Target::Shared(target) => target.store(rows, tag),
        }
    }

    /// The neighbours of each state.
    pub(super) fn neighbors(&self, rows: &[f64], k: u32) -> Result<Vec<Vec<Neighbor>>, Error> {
        match self {
            Target::Grpc(target) => target.neighbors(rows, k),
            Target::Shared(target) => target.neighbors(rows, k),
        }
    }

    /// Up to `most` ids of stored points.
    pub(super) fn ids(&self, most: usize) -> Result<Vec<u64>, Error> {
        match self {
            Target::Grpc(target) => target.ids(&Filter::default(), most),
            Target::Shared(target) => target.ids(most),
        }
    }

    /// Removes the points with a tag, and returns their number.
    pub(super) fn remove_tagged(&self, tag: u64) -> Result<u64, Error> {
        match self {
            Target::Grpc(target) => target.remove_tagged(tag),
            Target::Shared(target) => target.remove_tagged(tag),
        }
    }

    /// Waits until the server has acknowledged all writes, and returns the number of those that it did not take.
    pub(super) fn settle(&mut self) -> u64 {
        match self {
            Target::Grpc(_) => 0,
            Target::Shared(target) => target.settle(),
        }
    }

    /// Lets the connection live until `until` on this thread, or until `stopped`. True if `stopped`.
    pub(super) fn idle(
        &self,
        until: std::time::Instant,
        stopped: &mut tokio::sync::watch::Receiver<bool>,
    ) -> bool {
        let runtime = match self {
            Target::Grpc(target) => target.runtime(),
            Target::Shared(target) => target.runtime(),
        };
        let stop = stopped.wait_for(|stop| *stop);
        let ended = runtime.block_on(async { tokio::time::timeout_at(until.into(), stop).await });
        ended.is_ok()
    }
}

/// A runtime on the thread that calls it, for one connection or for waiting.
pub(super) struct OwnRuntime(Option<tokio::runtime::Runtime>);

impl OwnRuntime {
    fn new() -> Result<OwnRuntime, LoadError> {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build();
        let runtime = runtime.map_err(|source| LoadError::Thread { source })?;
        Ok(OwnRuntime(Some(runtime)))
    }
}

impl std::ops::Deref for OwnRuntime {
    type Target = tokio::runtime::Runtime;

    fn deref(&self) -> &tokio::runtime::Runtime {
        self.0.as_ref().expect("it is taken on drop alone")
    }
}

impl Drop for OwnRuntime {
    fn drop(&mut self) {
        // A plain drop panics on a thread of another runtime.
        if let Some(runtime) = self.0.take() {
            runtime.shutdown_background();
        }
    }
}
