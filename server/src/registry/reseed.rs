//! Starts a new generation of an index from the points of this server: an operator's way out if its servers contradict each
//! other, or if no server can follow its journal. The index gets a new uid and a new journal, and the other servers take copies.

use std::sync::Arc;

use thiserror::Error;

use super::restore::publish;
use crate::log::{
    Catalogue, Entry, Log, LogError, Origin, Record, RecordPosition, StoredPoint, Uid,
};

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
    /// The revisions of the journal that are gone.
    pub(crate) left_out: Result<LeftOut, LogError>,
}

/// The revisions of a journal that a new generation leaves out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct LeftOut {
    /// The newest revision at which the journal is not known to have another record than this server. Above it, up to the
    /// newest revision of this server, other servers have written other records.
    pub(crate) after: u64,
    /// The number of the journal's revisions after it.
    pub(crate) count: u64,
    /// True if both have the same record of `after`. Otherwise one of them no longer keeps it, and the times of the records
    /// are all that tells them apart.
    pub(crate) is_compared: bool,
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
    let left_out = left_out(log, old.uid, view.position());
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
        left_out,
    })
}

/// The comparison of the journal's record of a revision with that of this server.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Comparison {
    /// It is that of this server.
    Same,
    /// It is another one.
    Other,
    /// It cannot be compared.
    Unknown,
}

/// The revisions of the journal that are not among the records of this server, whose newest one is `own`. Blocks.
fn left_out(log: &Log, uid: Uid, own: RecordPosition) -> Result<LeftOut, LogError> {
    let newest = log.journal.newest(uid)?;
    let own_newest = log.points.retained(uid, own.revision)?;
    let compare = |revision: u64| -> Result<Comparison, LogError> {
        if revision == 0 {
            return Ok(Comparison::Same);
        }
        let Some(record) = journal_record(log, uid, revision)? else {
            return Ok(Comparison::Unknown);
        };
        let digest = match revision == own.revision {
            true => Some(own.digest),
            false => log.points.retained(uid, revision)?.map(|it| *it.digest()),
        };
        // This server made or applied its own record of the revision before its newest one.
        let is_younger = |newest: &Arc<Record>| record.time_ms() > newest.time_ms();
        Ok(match digest {
            Some(digest) if digest == *record.digest() => Comparison::Same,
            Some(_) => Comparison::Other,
            None if own_newest.as_ref().is_some_and(is_younger) => Comparison::Other,
            None => Comparison::Unknown,
        })
    };
    let mut after = newest.min(own.revision);
    let mut found = compare(after)?;
    if found == Comparison::Other {
        // A record names the one before it: after the first other one, all are others.
        let mut other = after;
        (after, found) = (0, Comparison::Same);
        while other - after > 1 {
            let middle = after + (other - after) / 2;
            match compare(middle)? {
                Comparison::Other => other = middle,
                same => (after, found) = (middle, same),
            }
        }
    }
    Ok(LeftOut {
        after,
        count: newest - after,
        is_compared: found == Comparison::Same,
    })
}

/// The record of a revision in the journal; None if the journal does not have it or it is damaged. Blocks.
fn journal_record(log: &Log, uid: Uid, revision: u64) -> Result<Option<Arc<Record>>, LogError> {
    match log.journal.read(uid, revision.checked_sub(1), 1) {
        Ok(records) => Ok(records.into_iter().find(|it| it.revision() == revision)),
        Err(LogError::Trimmed { .. } | LogError::JournalDamaged { .. }) => Ok(None),
        Err(error) => Err(error),
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::{
        log::{Durability, Effects, FjallLog, PointStore},
        testing::{arm, log_with, trim_all},
    };

    /// This many records after `position`, with the times from `time_ms` on.
    fn records(mut position: RecordPosition, count: u64, time_ms: u64) -> Vec<Arc<Record>> {
        let records = (0..count).map(|number| {
            let (revision, time_ms) = (position.revision + 1, time_ms + number);
            let record = Record::new(revision, position.digest, time_ms, Effects::new(1));
            position = record.position();
            Arc::new(record)
        });
        records.collect()
    }

    /// The revisions that a server leaves out whose records are `own` after the five that it shares with the journal, which
    /// has `others` after these. A server that is `trimmed` keeps its newest record alone.
    fn outcome(own: u64, others: u64, trimmed: bool) -> LeftOut {
        let entry = arm();
        let shared = records(RecordPosition::START, 5, 10);
        let position = shared.last().unwrap().position();
        let log = |count, time_ms| {
            let records = [shared.clone(), records(position, count, time_ms)].concat();
            log_with(&entry, &records)
        };
        let (points, journal) = (log(own, 20), log(others, 50));
        if trimmed {
            trim_all(&points, entry.uid);
        }
        let own = points.view(entry.uid).unwrap().position();
        let log = Log {
            journal,
            ..Log::from(points)
        };
        left_out(&log, entry.uid, own).unwrap()
    }

    #[test]
    fn a_reseed_knows_the_revisions_that_others_wrote() {
        let left_out = |after, count, is_compared| LeftOut {
            after,
            count,
            is_compared,
        };
        // The server is behind, or the journal has lost records.
        assert_eq!(outcome(0, 0, false), left_out(5, 0, true));
        assert_eq!(outcome(0, 4, false), left_out(5, 4, true));
        assert_eq!(outcome(9, 0, false), left_out(5, 0, true));
        // Others have written in the place of its records: fewer, as many, and more.
        for others in [1, 9, 12] {
            assert_eq!(outcome(9, others, false), left_out(5, others, true));
        }
        // The times tell that, if the server keeps no record to compare.
        assert_eq!(outcome(9, 0, true), left_out(5, 0, false));
        assert_eq!(outcome(9, 4, true), left_out(5, 4, false));
        assert_eq!(outcome(0, 4, true), left_out(5, 4, true));
    }

    #[test]
    fn a_reseed_of_an_index_whose_journal_is_gone_leaves_out_nothing() {
        let entry = arm();
        let points = log_with(&entry, &records(RecordPosition::START, 3, 10));
        let own = points.view(entry.uid).unwrap().position();
        let log = Log {
            journal: log_with(&entry, &[]),
            ..Log::from(points)
        };
        let expected = LeftOut {
            after: 0,
            count: 0,
            is_compared: true,
        };
        assert_eq!(left_out(&log, entry.uid, own), Ok(expected));
    }

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
