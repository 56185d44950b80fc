//! The Wayfold server: shared nearest-neighbour indices for motion planners.
//!
//! Dependencies point one way: `log, watermark ← registry, identity, admission ← service ← observe, status, request_bounds ←
//! config, verbs ← faces ← grpc ← http, zenoh, cluster, snapshots ← run ← cli`. The [`service`] knows no transport. `grpc`,
//! `zenoh` and `http` translate and guard their connections; they decide nothing about points or rights. The mutation
//! [`log`] is the only source of state.

// Helpers of the integration tests that unit tests include name the crate as those do.
#[cfg(test)]
extern crate self as wayfold_server;

pub mod config;
pub mod log;
pub mod registry;
pub mod service;
pub mod watermark;

mod admission;
mod cli;
mod cluster;
mod exposure;
mod faces;
mod grpc;
mod http;
mod huge_pages;
pub mod identity;
mod latency_gate;
mod lifecycle;
mod low_priority;
mod observe;
mod redact;
mod request_bounds;
mod run;
mod snapshots;
mod status;
mod verbs;
mod zenoh;

pub use cli::main;
pub use cluster::ClusterError;
pub use exposure::ExposedError;
pub use grpc::{GrpcError, InProcess, TlsError};
pub use huge_pages::use_small_pages;
pub use observe::{LogFormat, LoggingError};
pub use run::{ServerError, run};
pub use snapshots::SnapshotsError;
pub use zenoh::ZenohError;

#[cfg(test)]
#[path = "../tests/extremes/mod.rs"]
mod extremes;
#[cfg(test)]
#[path = "../tests/extremes/own_index.rs"]
mod own_index;
#[cfg(test)]
#[path = "../tests/extremes/quiet.rs"]
mod quiet;

#[cfg(test)]
mod testing;
