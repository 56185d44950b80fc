//! The status of a replica.

use std::sync::Arc;

use tokio::time::Instant;

use crate::{Error, Revision};

/// The state of a replica's connection to its server.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum ReplicaStatus {
    /// The replica applies mutations as they arrive.
    Following {
        /// The revision that reads see.
        revision: Revision,
        /// The number of revisions by which the server was ahead when it last sent something.
        behind: u64,
    },
    /// The replica has read all points and does not follow yet; or it reads them again, because the server no longer
    /// keeps the mutations that it missed, and reads see the old points.
    CatchingUp {
        /// The revision that reads see.
        revision: Revision,
    },
    /// The replica has no connection, and tries to get one. Reads see its last revision.
    Disconnected {
        /// The time at which the connection broke.
        since: Instant,
        /// The error that broke the connection, or that ended the last attempt.
        why: Arc<Error>,
    },
    /// The replica no longer follows the index, and reads fail.
    Ended {
        /// The cause.
        why: Arc<Error>,
    },
}
