//! The status of a replica.

use std::sync::Arc;

use tokio::time::Instant;

use crate::{Error, Revision};

/// The state of a replica's connection to its server.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum ReplicaStatus {
    /// It applies mutations as they come.
    Following {
        /// The revision that reads see.
        revision: Revision,
        /// The number of revisions by which the server was ahead when it last sent something.
        behind: u64,
    },
    /// It has read all points and does not follow yet; or it reads them again, since the server no longer keeps the
    /// mutations that it missed, and reads see the old ones.
    CatchingUp {
        /// The revision that reads see.
        revision: Revision,
    },
    /// It has no connection, and tries to get one. Reads see the last revision that it had.
    Disconnected {
        /// When the connection broke.
        since: Instant,
        /// The error that broke the connection, or that ended the last attempt.
        why: Arc<Error>,
    },
    /// It no longer follows the index, and reads fail.
    Ended {
        /// The cause.
        why: Arc<Error>,
    },
}
