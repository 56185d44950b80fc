//! The end-to-end suites in one program: one behaviour a file, one server process a test.

#![expect(
    clippy::unwrap_used,
    reason = "a test says what went wrong by where it panics"
)]

mod access;
mod backlog;
mod cancellation;
mod clients;
#[cfg(all(target_os = "linux", target_env = "gnu"))]
mod cluster;
mod crash;
#[cfg(all(target_os = "linux", target_env = "gnu"))]
mod disk_failure;
mod forwarding;
mod guests;
mod healing;
mod health;
#[cfg(target_os = "linux")]
mod idle_memory;
mod journal_loss;
mod large_mutation;
mod latest;
#[cfg(target_os = "linux")]
mod little_memory;
mod load;
mod metrics;
mod nats_access;
mod nats_settings;
mod no_missed_edge;
mod origins;
mod planners;
#[cfg(all(target_os = "linux", target_env = "gnu"))]
mod power_loss;
#[cfg(all(target_os = "linux", target_env = "gnu"))]
mod preload;
mod readme;
mod restore;
mod runbook;
mod server_program;
mod shared;
mod shutdown;
mod snapshots;
mod trimming;
mod unread_parts;
