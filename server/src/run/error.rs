//! The error of a server that does not start, or does not end well.

use std::io;

use thiserror::Error;

use crate::{
    cluster::ClusterError,
    exposure::ExposedError,
    grpc::{GrpcError, TlsError},
    identity::TableError,
    log::{NatsError, OpenError},
    registry::RegistryError,
    snapshots::SnapshotsError,
    zenoh::ZenohError,
};

/// The error of a server.
#[derive(Debug, Error)]
pub enum ServerError {
    /// The listener cannot be used.
    #[error("cannot use the listener: {0}")]
    Listener(#[from] io::Error),
    /// gRPC failed.
    #[error(transparent)]
    Grpc(#[from] GrpcError),
    /// Zenoh failed.
    #[error(transparent)]
    Zenoh(#[from] ZenohError),
    /// The certificates cannot be used.
    #[error(transparent)]
    Tls(#[from] TlsError),
    /// The identities cannot be used.
    #[error(transparent)]
    Identities(#[from] TableError),
    /// The pages for operators have no address.
    #[error(
        "cannot listen on {listen} for /metrics: {source}\n  \
         choose another address with http.listen (--http 127.0.0.1:0 takes any free port, --http off does without)"
    )]
    Pages {
        /// The address.
        listen: String,
        /// The problem.
        source: io::Error,
    },
    /// The server cannot be a member of its cluster.
    #[error(transparent)]
    Cluster(#[from] ClusterError),
    /// The snapshots cannot be written.
    #[error(transparent)]
    Snapshots(#[from] SnapshotsError),
    /// Callers beyond this machine could do everything.
    #[error(transparent)]
    Exposed(#[from] ExposedError),
    /// The data directory could not be opened.
    #[error(transparent)]
    Data(#[from] OpenError),
    /// The journal in NATS cannot be used.
    #[error(transparent)]
    Nats(#[from] NatsError),
    /// The log cannot be replayed.
    #[error("cannot replay the log: {0}")]
    Replay(#[from] RegistryError),
    /// The server ended without a shutdown signal: a bug.
    #[error("the server ended without a shutdown signal; this is a bug")]
    Ended,
    /// The server stopped and cut the calls that were not done after `shutdown.grace_ms`. Connections without a call do
    /// not count.
    #[error(
        "{calls} calls were cut: they were not done {grace_ms} ms after the server began to stop (shutdown.grace_ms)"
    )]
    Cut {
        /// The number of calls that were cut.
        calls: usize,
        /// The time they had to finish, in milliseconds.
        grace_ms: u64,
    },
}
