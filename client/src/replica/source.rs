//! Where a replica hears of mutations.

use std::time::Duration;

#[cfg(feature = "zenoh")]
use super::publications::Publications;
use crate::{Error, IndexHandle, Watch};

/// See the module.
#[derive(Clone, Debug, Default)]
pub(super) enum Source {
    /// From the server that it reads all points from.
    #[default]
    Server,
    #[cfg(feature = "zenoh")]
    Zenoh(Publications),
}

impl Source {
    /// Follows an index from a revision on. `_quiet`: after how long without a word to look whether one was lost.
    pub(super) async fn watch(
        &self,
        index: &IndexHandle,
        after: u64,
        _quiet: Duration,
    ) -> Result<Watch, Error> {
        match self {
            Source::Server => index.watch().after(after).await,
            #[cfg(feature = "zenoh")]
            Source::Zenoh(publications) => publications.watch(index, after, _quiet).await,
        }
    }
}
