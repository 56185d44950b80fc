//! The Wayfold server: shared nearest-neighbour indices for motion planners.
//!
//! Dependencies point one way: `log, watermark ← registry ← identity ← service ← grpc, zenoh, http, snapshots ← cluster ←
//! run ← cli`. The [`service`] knows no transport. `grpc`, `zenoh` and `http` translate and hold no policy. The mutation [`log`] is
//! the only record of an index's past.

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
pub mod identity;
mod latency_gate;
mod lifecycle;
mod low_priority;
mod observe;
mod pages;
mod run;
mod snapshots;
mod status;
mod verbs;
mod wrong_text;
mod zenoh;

pub use cli::main;
pub use cluster::ClusterError;
pub use exposure::ExposedError;
pub use grpc::{GrpcError, InProcess, TlsError};
pub use observe::{LogFormat, LoggingError};
pub use pages::use_small_pages;
pub use run::{ServerError, run};
pub use snapshots::SnapshotsError;
pub use zenoh::ZenohError;

#[cfg(test)]
#[path = "../tests/extremes/mod.rs"]
mod extremes;
#[cfg(test)]
#[path = "../tests/extremes/quiet.rs"]
mod quiet;

#[cfg(test)]
mod testing {
    use std::sync::Arc;

    use proptest::{prelude::ProptestConfig, test_runner::RngSeed};

    use crate::log::{Catalogue, Effects, Entry, Journal, MemoryLog, PointStore, Record, Uid};

    /// A log with an index `arm` of R1 that has applied this many records without points.
    pub(crate) fn recorded(records: u64) -> Arc<MemoryLog> {
        let entry = Entry {
            uid: Uid::unique(),
            name: "arm".into(),
            space: "R1".parse().expect("a space"),
            payload_encoding: Default::default(),
        };
        let (uid, log) = (entry.uid, Arc::new(MemoryLog::new()));
        log.create(entry).expect("a new index");
        for _ in 0..records {
            let position = log.view(uid).expect("a view").position();
            let record = Arc::new(Record::after(position, Effects::new(1)));
            log.submit(uid, Arc::clone(&record)).expect("a receipt");
            log.apply(uid, &[record]).expect("a view");
        }
        log
    }

    /// Property tests run `cases` cases, the same ones in every run.
    pub(crate) fn cases(cases: u32) -> ProptestConfig {
        ProptestConfig {
            cases,
            rng_seed: RngSeed::Fixed(cases.into()),
            failure_persistence: None,
            ..ProptestConfig::default()
        }
    }
}
