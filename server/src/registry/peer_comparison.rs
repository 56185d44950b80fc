//! The state of the comparison of an index's records with those of the other members of a cluster.

use std::sync::atomic::AtomicU64;

use tokio::{sync::Mutex, time::Instant};

/// The comparison that a server makes before its first record of an index, and again after each change of the members.
#[derive(Default)]
pub(crate) struct PeerComparison {
    /// The count of changes when the last comparison began; 0 before it. The live servers and the connection to NATS change, and
    /// each resumption of the index counts as a change.
    pub(crate) compared: AtomicU64,
    /// The number of times that the index has resumed.
    pub(crate) resumptions: AtomicU64,
    /// Held while they are compared. It has the last failure.
    pub(crate) turn: Mutex<Option<ComparisonFailure>>,
}

/// The records could not be compared, or differ.
pub(crate) struct ComparisonFailure {
    /// The time at which that was found.
    pub(crate) at: Instant,
    /// True if they differ.
    pub(crate) is_loss: bool,
    /// The reason.
    pub(crate) what: String,
}
