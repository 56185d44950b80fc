//! The status of a shared index.

use std::{sync::Arc, time::Instant};

use crate::Error;

/// The state of a shared index's connection to its server.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum ConnectionStatus {
    /// Writes of others are applied as they arrive.
    Following {
        /// The number of revisions by which the server was ahead when it last sent something.
        behind: u64,
    },
    /// The copy reads all points again, because the server no longer keeps the mutations that it missed. Reads see the
    /// old points and own writes.
    Reloading,
    /// The server cannot be reached, or it asks to send the writes later, because it has too much to do or no memory
    /// left. The index tries again. Reads see what has arrived and own writes; writes wait in memory.
    Disconnected {
        /// The time of the first attempt that failed.
        since: Instant,
        /// The error that ended the last attempt.
        why: Arc<Error>,
    },
    /// The server refused a write for good. Reads go on; writes fail until
    /// [`Index::take_unsent`](crate::Index::take_unsent).
    Refused {
        /// The refusal.
        why: Arc<Error>,
    },
    /// The index is gone, has another space, or was given up after a panic in its background: reads and writes fail.
    Ended {
        /// The cause.
        why: Arc<Error>,
    },
    /// [`Index::close`](crate::Index::close) was called.
    Closed,
}
