//! The revisions that a server stores of its indices, by which the servers that share a journal trim it.

use std::{
    collections::{BTreeSet, HashMap},
    sync::Arc,
    time::{Duration, SystemTime},
};

use super::{Hosted, Registry};
use crate::log::{LogError, Uid};

/// The bounds of the time between two trims of old records.
const MIN_TRIM_INTERVAL: Duration = Duration::from_secs(1);
const MAX_TRIM_INTERVAL: Duration = Duration::from_secs(60);

/// The newest revision of an index that a server stores.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Stored {
    /// The newest revision that it has as long as it runs or, if it survives a loss of power, that it has afterwards.
    pub(crate) revision: u64,
    /// True if it survives a loss of power.
    pub(crate) is_durable: bool,
}

impl Registry {
    /// The time between two trims of old records: a short window is not exceeded by far.
    pub(crate) fn trim_interval(&self) -> Duration {
        let window = self.host.options.window;
        window.clamp(MIN_TRIM_INTERVAL, MAX_TRIM_INTERVAL)
    }

    /// What this server stores of those of its indices that have these uids.
    pub(crate) fn stored(&self, uids: &BTreeSet<Uid>) -> HashMap<Uid, Stored> {
        let hosted = self.hosted().into_iter();
        let asked = hosted.filter(|hosted| uids.contains(&hosted.uid()));
        let stored = asked.filter_map(|hosted| Some((hosted.uid(), hosted.stored().ok()?)));
        stored.collect()
    }

    /// The indices that follow a journal elsewhere.
    pub(crate) fn following(&self) -> Vec<Arc<Hosted>> {
        let mut hosted = self.hosted();
        hosted.retain(|hosted| hosted.is_shared() && hosted.follows());
        hosted
    }
}

impl Hosted {
    fn stored(&self) -> Result<Stored, LogError> {
        let applied = self.published().revision;
        let durable = self.host.log.points.durable(self.uid())?;
        Ok(Stored {
            revision: durable.map_or(applied, |durable| durable.min(applied)),
            // A server that has stopped may store records that the journal does not have.
            is_durable: durable.is_some() && self.follows(),
        })
    }

    /// Forgets the records of a journal elsewhere up to this revision that are outside the window. Blocks.
    pub(crate) fn forget(&self, up_to: u64) -> Result<(), LogError> {
        self.trim(SystemTime::now())?;
        self.host.log.journal.forget(self.uid(), up_to)
    }
}
