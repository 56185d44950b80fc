//! What a replica knows of itself.

use std::sync::Arc;

use tokio::time::Instant;

use crate::Error;

/// How a replica stands to its server.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum ReplicaStatus {
    /// It applies mutations as they come.
    Following {
        /// The revision that reads see.
        revision: u64,
        /// How many revisions the server was ahead, by its last word.
        behind: u64,
    },
    /// It has read all points and does not follow yet; or it reads them anew, since the server could not tell what it
    /// had missed, and reads see the old ones.
    CatchingUp {
        /// The revision that reads see.
        revision: u64,
    },
    /// It has no connection, and tries to get one. Reads see what it had.
    Disconnected {
        /// Since when.
        since: Instant,
        /// What broke it, or why the last try failed.
        why: Arc<Error>,
    },
    /// It follows no more, and reads fail.
    Ended {
        /// Why.
        why: Arc<Error>,
    },
}
