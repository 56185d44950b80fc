//! The revisions that a server stores of its indices, by which the servers that share a journal trim it.

use std::{
    collections::{BTreeMap, HashMap},
    sync::{Arc, atomic::Ordering::Relaxed},
    time::{Duration, SystemTime},
};

use tracing::debug;

use super::{Hosted, Registry, RegistryError};
use crate::log::{LogError, RecordPosition, Uid};

/// The bounds of the time between two trims of old records.
const MIN_TRIM_INTERVAL: Duration = Duration::from_secs(1);
const MAX_TRIM_INTERVAL: Duration = Duration::from_secs(60);

/// The newest revision of an index that a server stores.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct StoredRevision {
    /// The newest stored revision; if `is_durable`, the newest that survives a loss of power.
    pub(crate) revision: u64,
    /// True if it survives a loss of power.
    pub(crate) is_durable: bool,
    /// The oldest revision in its window; None if that has no record, as after a copy.
    pub(crate) oldest: Option<u64>,
    /// The newest record that it has applied.
    pub(crate) applied: RecordPosition,
    /// The record of the revision that was asked for, if the server keeps it.
    pub(crate) requested: Option<RecordPosition>,
}

impl Registry {
    /// The time between two trims of old records: a short window is not exceeded by far.
    pub(crate) fn trim_interval(&self) -> Duration {
        let window = self.host.options.window;
        window.clamp(MIN_TRIM_INTERVAL, MAX_TRIM_INTERVAL)
    }

    /// The stored revisions of this server's indices with these uids. A revision beside a uid asks for the record of that
    /// revision too. Blocks.
    pub(crate) fn stored(
        &self,
        requested: &BTreeMap<Uid, Option<u64>>,
    ) -> HashMap<Uid, StoredRevision> {
        let hosted = self.hosted().into_iter();
        let stored = hosted.filter_map(|hosted| {
            let revision = requested.get(&hosted.uid())?;
            Some((hosted.uid(), hosted.stored(*revision)))
        });
        stored.collect()
    }

    /// The indices that follow a shared journal.
    pub(crate) fn following(&self) -> Vec<Arc<Hosted>> {
        let mut hosted = self.hosted();
        hosted.retain(|hosted| hosted.is_shared() && !hosted.is_closed());
        hosted
    }
}

impl Hosted {
    /// Tells what this server stores. While its store fails, it tells the others only what it has applied.
    fn stored(&self, requested: Option<u64>) -> StoredRevision {
        let applied = self.published().view.position();
        let stored = self.read_stored(applied, requested);
        stored.unwrap_or_else(|error| {
            debug!(index = self.name(), %error, "cannot read what is stored");
            StoredRevision {
                revision: 0,
                is_durable: false,
                oldest: None,
                applied,
                requested: None,
            }
        })
    }

    fn read_stored(
        &self,
        position: RecordPosition,
        requested: Option<u64>,
    ) -> Result<StoredRevision, RegistryError> {
        let applied = position.revision;
        let requested = match requested {
            Some(revision) => self
                .digest_at(revision)?
                .map(|digest| RecordPosition { revision, digest }),
            None => None,
        };
        let durable = self.host.log.points.durable(self.uid())?;
        Ok(StoredRevision {
            revision: durable.map_or(applied, |durable| durable.min(applied)),
            // A server that has stopped may store records that the journal does not have.
            is_durable: durable.is_some() && !self.is_closed(),
            oldest: self.host.log.points.oldest(self.uid())?,
            applied: position,
            requested,
        })
    }

    /// Forgets the records of a shared journal up to this revision that are outside the window. Blocks.
    pub(crate) fn forget(&self, up_to: u64) -> Result<(), LogError> {
        self.trim(SystemTime::now())?;
        if self.forgotten.load(Relaxed) >= up_to {
            return Ok(());
        }
        self.host.log.journal.forget(self.uid(), up_to)?;
        self.forgotten.store(up_to, Relaxed);
        Ok(())
    }

    /// Counts the records of a shared journal up to this revision, which are kept although all windows are behind them.
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
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        log::Catalogue,
        registry::RegistryOptions,
        testing::{recorded, registry},
    };

    #[tokio::test]
    async fn a_server_whose_store_fails_tells_what_it_has_applied() {
        let local = recorded(3);
        let registry = registry(&local, &local, RegistryOptions::default());
        let hosted = registry.get("arm").unwrap();
        let uid = hosted.uid();
        let asked = || registry.stored(&BTreeMap::from([(uid, Some(2))]))[&uid];
        let before = asked();
        assert_eq!(before.applied, hosted.published().view.position());
        assert!(before.revision == 3 && before.requested.is_some());
        local.delete(uid).unwrap();
        let expected = StoredRevision {
            revision: 0,
            oldest: None,
            requested: None,
            ..before
        };
        assert_eq!(asked(), expected);
    }
}
