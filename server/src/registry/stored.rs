//! The revisions that a server stores of its indices, by which the servers that share a journal trim it.

use std::{
    collections::{BTreeSet, HashMap},
    sync::{Arc, atomic::Ordering::Relaxed},
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
    /// The oldest revision in its window; None if that has no record, as after a copy.
    pub(crate) oldest: Option<u64>,
}

impl Registry {
    /// The time between two trims of old records: a short window is not exceeded by far.
    pub(crate) fn trim_interval(&self) -> Duration {
        let window = self.host.options.window;
        window.clamp(MIN_TRIM_INTERVAL, MAX_TRIM_INTERVAL)
    }

    /// What this server stores of those of its indices that have these uids. Blocks.
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
            oldest: self.host.log.journal.oldest_kept(self.uid())?,
        })
    }

    /// Forgets the records of a journal elsewhere up to this revision that are outside the window. Blocks.
    pub(crate) fn forget(&self, up_to: u64) -> Result<(), LogError> {
        self.trim(SystemTime::now())?;
        self.host.log.journal.forget(self.uid(), up_to)
    }

    /// Counts the records of a journal elsewhere up to this revision, which are kept although all windows are behind them.
    /// Blocks.
    pub(crate) fn count_held(&self, outside: u64) -> Result<u64, LogError> {
        let oldest = self.host.log.journal.oldest(self.uid())?;
        let held = oldest.map_or(0, |oldest| (outside + 1).saturating_sub(oldest));
        self.held.store(held, Relaxed);
        Ok(held)
    }

    /// Notes that no record is kept beyond the windows, or that another server counts them.
    pub(crate) fn count_none_held(&self) {
        self.held.store(0, Relaxed);
    }

    /// The records that were counted last.
    pub(crate) fn held(&self) -> u64 {
        self.held.load(Relaxed)
    }
}
