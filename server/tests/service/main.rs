//! The promises of every call, tested on the service without a transport.

#![expect(
    clippy::unwrap_used,
    reason = "a test that cannot go on has failed; clippy spares only what is marked as a test itself"
)]

mod cancellation;
mod concurrent;
#[path = "../log/copied.rs"]
mod copied;
mod durability;
mod extreme_integers;
#[expect(dead_code, reason = "only other suites vary the request of every verb")]
#[path = "../extremes/mod.rs"]
mod extremes;
#[path = "../log/fault/mod.rs"]
mod fault;
mod faults;
mod forward;
mod held_scans;
mod idle_index;
mod in_flight;
mod indexes;
mod insert;
#[path = "../log/journal_end.rs"]
mod journal_end;
mod lifecycle;
mod limits;
mod log;
mod merging;
mod model;
mod operations;
#[expect(dead_code, reason = "only other suites set a deadline")]
#[path = "../extremes/quiet.rs"]
mod quiet;
mod quotas;
mod random;
mod reads;
mod refusals;
mod remote;
mod replay;
mod restore;
mod restored_sessions;
#[path = "../extremes/restores.rs"]
mod restores;
mod scaling;
mod scan;
mod sessions;
mod slow_disk;
mod snapshot;
mod storage_failure;
mod store;
mod support;
#[path = "../log/tables.rs"]
mod tables;
mod trims;
mod update;
mod verify;
mod watch;
mod watermarks;
