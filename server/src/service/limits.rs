//! The limits of one call, and of the memory kept for retries.

use std::time::Duration;

use serde::Deserialize;
use wayfold_index::Space;

use super::Error;
use crate::registry::OperationWindow;

/// Limits that protect the server and its clients; a call that exceeds one is refused with the limit's name and value.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Limits {
    /// The most states of one `Insert`, `Knn` or `Query`, and most steps of one `Write`.
    pub max_rows_per_call: usize,
    /// The most ids of one `Get`, `Update` or `Remove`.
    pub max_ids_per_call: usize,
    /// The most neighbours of a state.
    pub max_k: usize,
    /// The most bytes of one encoded answer. Stock gRPC clients refuse messages above 4 MiB, so the default stays
    /// below.
    pub max_answer_bytes: usize,
    /// The most indices on the server.
    pub max_indexes: usize,
    /// The most seconds that a scan, a snapshot or a verification holds its revision.
    pub max_scan_seconds: u64,
    /// The most scans over Zenoh that hold a revision between two pages.
    pub max_held_scans: usize,
    /// The most operations (calls with an `operation_id`) that an index remembers for their retries. The window ends at
    /// this limit or at `max_operation_bytes`, the one reached first.
    pub max_operations: usize,
    /// The most bytes of remembered operations, their responses included, for each index.
    pub max_operation_bytes: usize,
    /// The most writer sessions of an index.
    pub max_sessions: usize,
    /// The most seconds between two batches of a writer session. A session that is idle for longer is ended.
    pub max_session_idle_seconds: u64,
    /// The most ids that one `OpenSession` or `Write` reserves.
    pub max_reserved_ids: u64,
    /// The most points of one index; 0 for any number.
    pub max_points_per_index: u64,
    /// The most bytes of the states of one index; 0 for any number.
    pub max_state_bytes_per_index: u64,
    /// The most bytes of the payloads of one index; 0 for any number.
    pub max_payload_bytes_per_index: u64,
    /// The most bytes of one payload. Fixed by the contract, no setting.
    #[serde(skip)]
    pub max_payload_bytes: usize,
    /// Time that a read without a deadline waits for its `min_revision`. Fixed by the contract, no setting.
    #[serde(skip)]
    pub min_revision_wait: Duration,
}

impl Limits {
    /// The operations that an index remembers.
    pub fn operations(&self) -> OperationWindow {
        OperationWindow {
            count: self.max_operations,
            bytes: self.max_operation_bytes,
        }
    }
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            max_rows_per_call: 100_000,
            max_ids_per_call: 100_000,
            max_k: 10_000,
            max_answer_bytes: 4 * 1024 * 1024 - 1024,
            max_indexes: 10_000,
            max_scan_seconds: 300,
            max_held_scans: 64,
            max_operations: OperationWindow::default().count,
            max_operation_bytes: OperationWindow::default().bytes,
            max_sessions: 65_536,
            max_session_idle_seconds: 7 * 24 * 3600,
            max_reserved_ids: 1 << 20,
            max_points_per_index: 0,
            max_state_bytes_per_index: 0,
            max_payload_bytes_per_index: 0,
            max_payload_bytes: 64 * 1024,
            min_revision_wait: Duration::from_secs(5),
        }
    }
}

impl Limits {
    /// Refuses `points` points of `space` in one index if they exceed a quota of it.
    pub(super) fn check_quotas(
        &self,
        index: &str,
        space: &Space,
        points: u64,
    ) -> Result<(), Error> {
        let state_bytes = points.saturating_mul(8 * space.coordinates() as u64);
        let quotas = [
            ("max_points_per_index", self.max_points_per_index, points),
            (
                "max_state_bytes_per_index",
                self.max_state_bytes_per_index,
                state_bytes,
            ),
        ];
        quotas.into_iter().try_for_each(|quota| check(index, quota))
    }

    /// Refuses payloads of `bytes` in total in one index if that exceeds the limit.
    pub(super) fn check_payloads(&self, index: &str, bytes: u64) -> Result<(), Error> {
        let value = self.max_payload_bytes_per_index;
        check(index, ("max_payload_bytes_per_index", value, bytes))
    }
}

/// Refuses a request above a quota that is not 0.
fn check(index: &str, (limit, value, requested): (&'static str, u64, u64)) -> Result<(), Error> {
    if value == 0 || requested <= value {
        return Ok(());
    }
    Err(Error::QuotaExceeded {
        index: index.into(),
        limit,
        value,
        requested,
    })
}
