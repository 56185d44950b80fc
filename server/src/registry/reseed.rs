//! Starts a new generation of an index from the points of this server: an operator's way out if its servers contradict each
//! other, or if no server can follow its journal. The index gets a new uid and a new journal, and the other servers take copies.

use thiserror::Error;

use super::restore::publish;
use crate::log::{Catalogue, Entry, Log, LogError, Origin, StoredPoint, Uid};

/// The points that are written at a time.
const PAGE_POINTS: usize = 4096;

/// The index of this server that gets a new generation.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seed<'a> {
    /// Its name.
    pub(crate) name: &'a str,
    /// Its uid, if several indices of the point store have the name.
    pub(crate) uid: Option<Uid>,
}

/// A new generation of an index.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Reseeded {
    /// The uid before.
    pub(crate) old: Uid,
    /// The uid now.
    pub(crate) new: Uid,
    /// The revision with which it begins.
    pub(crate) revision: u64,
    /// The number of its points.
    pub(crate) points: u64,
    /// The number of later revisions in the journal, which are gone.
    pub(crate) left_out: Result<u64, LogError>,
}

/// The index has no new generation.
#[derive(Debug, Error)]
pub(crate) enum ReseedError {
    /// The server has no such index.
    #[error("the data directory has no index of this name and uid")]
    Missing,
    /// The server has several.
    #[error(
        "the data directory has several indices of this name; choose one with --uid: {}",
        uids.iter().map(|(uid, revision)| format!("{uid} (revision {revision})")).collect::<Vec<_>>().join(", ")
    )]
    Several {
        /// The uid and the newest revision of each.
        uids: Vec<(Uid, u64)>,
    },
    /// Another index has the name.
    #[error(
        "another index has this name now: the one in this directory, {old}, was deleted or reseeded elsewhere, or \
         this server may have lost mutations that were not synced and gave it a new uid; `wayfold delete` the other \
         one first, if the points here are to take its place"
    )]
    Replaced {
        /// The uid of the index in the directory.
        old: Uid,
    },
    /// The log failed.
    #[error(transparent)]
    Log(#[from] LogError),
}

/// Makes the points and sessions of an index of the point store a new index of the same name. `local` is the catalogue of the
/// point store. No server may use the store meanwhile. Blocks.
pub(crate) fn reseed(
    log: &Log,
    local: &dyn Catalogue,
    seed: Seed<'_>,
) -> Result<Reseeded, ReseedError> {
    let is_seed = |name: &str, uid: Uid| name == seed.name && seed.uid.is_none_or(|it| it == uid);
    let mut entries = local.indexes()?;
    entries.retain(|entry| is_seed(&entry.name, entry.uid));
    let [old] = &entries[..] else {
        if entries.is_empty() {
            let mut lost = local.lost().into_iter();
            let lost = lost.find(|lost| is_seed(&lost.name, lost.uid));
            let why = lost.map(|lost| lost.why).or_else(|| log.points.failure());
            return Err(why.map_or(ReseedError::Missing, ReseedError::Log));
        }
        let uids = entries.iter().map(|entry| {
            let view = log.points.view(entry.uid);
            (entry.uid, view.map_or(0, |view| view.revision()))
        });
        let uids = uids.collect();
        return Err(ReseedError::Several { uids });
    };
    let view = log.points.view(old.uid)?;
    let entry = Entry {
        uid: Uid::unique(),
        ..old.clone()
    };
    let origin = Origin {
        revision: view.revision(),
        next_id: view.next_id(),
        digest: view.position().digest,
    };
    let mut restoring = log.points.restore(entry.clone(), origin, false)?;
    let (mut after, mut points) = (None, 0);
    loop {
        let page = view.page(after, PAGE_POINTS)?;
        let Some(last) = page.last() else {
            break;
        };
        after = Some(last.id);
        points += page.len() as u64;
        let page: Vec<StoredPoint> = page.iter().map(|point| StoredPoint::clone(point)).collect();
        restoring.add(&page)?;
    }
    restoring.finish(view.sessions().clone(), Vec::new())?;
    // A journal that has lost the index is one of the reasons for this call.
    let newest = log.journal.newest(old.uid);
    let run = *Uid::unique().as_bytes();
    publish(log, run, &entry, Some(old.uid), origin).map_err(|error| match error {
        LogError::NameTaken { .. } => ReseedError::Replaced { old: old.uid },
        error => error.into(),
    })?;
    Ok(Reseeded {
        old: old.uid,
        new: entry.uid,
        revision: origin.revision,
        points,
        left_out: newest.map(|newest| newest.saturating_sub(origin.revision)),
    })
}

#[cfg(test)]
mod tests {
    use std::{fs, sync::Arc};

    use super::*;
    use crate::log::{Durability, FjallLog};

    #[test]
    fn an_index_that_cannot_be_read_is_not_called_missing() {
        let directory = tempfile::tempdir().unwrap();
        let open = || Arc::new(FjallLog::open(directory.path(), Durability::Fsync).unwrap());
        let refused = |local: Arc<FjallLog>, name| {
            let seed = Seed { name, uid: None };
            reseed(&Log::from(Arc::clone(&local)), &*local, seed).unwrap_err()
        };
        let local = open();
        local
            .create(Entry {
                uid: Uid::unique(),
                name: "arm".into(),
                space: "R1".parse().unwrap(),
                payload_encoding: Default::default(),
            })
            .unwrap();
        assert!(matches!(refused(local, "leg"), ReseedError::Missing));
        fs::remove_dir_all(directory.path().join("store")).unwrap();
        // The marks still name the first.
        for name in ["arm", "leg"] {
            let why = refused(open(), name);
            let is_unopened = matches!(why, ReseedError::Log(LogError::Unopened { .. }));
            assert!(is_unopened, "{why}");
        }
    }
}
