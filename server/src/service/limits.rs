//! The limits of one call, and of the memory kept for retries.

use std::time::Duration;

use serde::Deserialize;

/// Limits that protect the server and its clients; a call that exceeds one is refused with the limit's name and value.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Limits {
    /// Most states of one `Insert`, `Knn` or `Query`.
    pub rows_per_call: usize,
    /// Most ids of one `Get`, `Update` or `Remove`.
    pub ids_per_call: usize,
    /// Most neighbours of a state.
    pub k: usize,
    /// Most bytes of one encoded answer. Stock gRPC clients refuse messages above 4 MiB, so the default stays below.
    pub answer_bytes: usize,
    /// Most indices on the server.
    pub indexes: usize,
    /// Most seconds that a scan, a snapshot or a verification holds its revision.
    pub scan_seconds: u64,
    /// Most operations (calls with an `operation_id`) that an index remembers for their retries. The window ends at this
    /// limit or at `operation_bytes`, the one reached first.
    pub operations_remembered: usize,
    /// Most bytes of remembered operations, their responses included, for each index.
    pub operation_bytes: usize,
    /// Most bytes of one payload. Fixed by the contract, no setting.
    #[serde(skip)]
    pub payload_bytes: usize,
    /// Time that a read without a deadline waits for its `min_revision`. Fixed by the contract, no setting.
    #[serde(skip)]
    pub min_revision_wait: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            rows_per_call: 100_000,
            ids_per_call: 100_000,
            k: 10_000,
            answer_bytes: 4 * 1024 * 1024 - 1024,
            indexes: 10_000,
            scan_seconds: 300,
            operations_remembered: 10_000,
            operation_bytes: 16 * 1024 * 1024,
            payload_bytes: 64 * 1024,
            min_revision_wait: Duration::from_secs(5),
        }
    }
}
