//! The sources of a replica's mutations.

use std::time::Duration;

#[cfg(feature = "zenoh")]
use crate::index::shared::publications::Publications;
use crate::{Error, IndexHandle, Revision, Watch};

/// See the module.
#[derive(Clone, Debug, Default)]
pub(super) enum Source {
    /// The server that it reads all points from.
    #[default]
    Server,
    #[cfg(feature = "zenoh")]
    Zenoh(Publications),
}

impl Source {
    /// Watches an index after a revision. After the time `_quiet` without a message, the source checks for losses.
    pub(super) async fn watch(
        &self,
        index: &IndexHandle,
        after: Revision,
        _quiet: Duration,
    ) -> Result<Watch, Error> {
        match self {
            Source::Server => index.watch().after(after).await,
            #[cfg(feature = "zenoh")]
            Source::Zenoh(publications) => publications.watch(index, after, _quiet).await,
        }
    }
}
