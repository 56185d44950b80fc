//! A flipped bit in any file of a closed log. Either the content of the log stays equal bit by bit, or the log reports
//! damage. In the small files that every index depends on, a flipped bit changes nothing.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    sync::Arc,
};

use wayfold_server::log::{
    Catalogue, Durability, Entry, FjallLog, Journal, LogError, Operation, PointStore, Record,
    StoredPoint, Uid, repair,
};

use crate::{copied::copied, effects, entry, submit, tables::move_to_tables};

/// The approximate maximum number of flips in a file, unless the environment variable `FLIPS` sets another.
const FLIPS: u64 = 16;

/// The number of revisions of an index in tables; as many again stay in the journal.
const REVISIONS: u64 = 40;

/// The ids that the effects of a revision store and remove.
fn changed(revision: u64) -> ([u64; 3], [u64; 1]) {
    let first = revision * 2;
    ([first, first + 1, revision % 7], [first.saturating_sub(9)])
}

/// Two indices, the first half of both in tables and the rest in the journal.
fn fill(directory: &Path) -> Vec<Entry> {
    let entries = vec![entry("arm"), entry("base")];
    for half in 0..2 {
        let log = FjallLog::open(directory, Durability::Fsync).unwrap();
        for entry in &entries {
            if half == 0 {
                log.create(entry.clone()).unwrap();
            }
            for revision in half * REVISIONS + 1..=(half + 1) * REVISIONS {
                let (stored, removed) = changed(revision);
                let effects = effects(revision, &stored, &removed);
                submit(&log, entry.uid, revision - 1, effects).unwrap();
            }
        }
        drop(log);
        if half == 0 {
            move_to_tables(directory);
        }
    }
    entries
}

/// The whole content of an index in a log.
type Content = (
    BTreeMap<u64, Arc<StoredPoint>>,
    Vec<Arc<Record>>,
    Vec<Arc<Operation>>,
    u64,
);

fn content(log: &FjallLog, uid: Uid) -> Result<Content, LogError> {
    let view = log.view(uid)?;
    let mut points = BTreeMap::new();
    let mut after = None;
    while let page = view.page(after, 7)?
        && let Some(last) = page.last()
    {
        after = Some(last.id);
        points.extend(page.into_iter().map(|point| (point.id, point)));
    }
    Ok((
        points,
        log.read(uid, None, usize::MAX)?,
        log.operations(uid)?,
        view.next_id(),
    ))
}

fn files(directory: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for file in fs::read_dir(directory).unwrap() {
        let path = file.unwrap().path();
        if path.is_dir() {
            files.extend(self::files(&path));
        } else {
            files.push(path);
        }
    }
    files.sort();
    files
}

/// True for the files that the log repairs: `version`, `current`, the list that `current` names, and their copy.
fn is_mended(name: &Path) -> bool {
    let last = name.file_name().unwrap().to_str().unwrap();
    let is_list = last
        .strip_prefix('v')
        .is_some_and(|number| number.parse::<u64>().is_ok());
    ["version", "current", "manifest-copy"].contains(&last) || is_list
}

/// Returns true if the log reports damage. Asserts that all indices without a report are unchanged.
fn is_reported(directory: &Path, entries: &[Entry], whole: &[Content], what: &str) -> bool {
    let Ok(log) = FjallLog::open(directory, Durability::Fsync) else {
        return true;
    };
    let mut is_reported = false;
    for (entry, whole) in entries.iter().zip(whole) {
        let gone = log.lost().iter().any(|gone| gone.uid == entry.uid);
        is_reported |= gone;
        match content(&log, entry.uid) {
            Ok(content) => assert!(content == *whole, "{what}: {} is another", entry.name),
            Err(LogError::UnknownIndex { .. }) => assert!(gone, "{what}: {} is gone", entry.name),
            Err(_) => is_reported = true,
        }
    }
    is_reported
}

#[test]
fn a_flipped_bit_of_any_file_is_reported_or_changes_nothing() {
    let flips = std::env::var("FLIPS").map_or(FLIPS, |flips| flips.parse().unwrap());
    let directory = tempfile::tempdir().unwrap();
    let entries = fill(directory.path());
    // The log is opened and closed once more, so that the journal is no longer than its content.
    let log = FjallLog::open(directory.path(), Durability::Fsync).unwrap();
    let whole: Vec<Content> = entries
        .iter()
        .map(|entry| content(&log, entry.uid).unwrap())
        .collect();
    drop(log);
    let (mut reported, mut harmless, mut mended) = (0, 0, 0);
    for path in files(directory.path()) {
        let name = path.strip_prefix(directory.path()).unwrap();
        let bytes = fs::read(&path).unwrap();
        let step = (bytes.len() as u64).div_ceil(flips).max(1) | 1;
        let before = (reported, harmless);
        for at in (0..bytes.len()).step_by(step as usize) {
            let copy = copied(directory.path());
            let mut flipped = bytes.clone();
            flipped[at] ^= 1 << (at % 8);
            fs::write(copy.path().join(name), flipped).unwrap();
            let what = format!("bit {} of byte {at} of {}", at % 8, name.display());
            match is_reported(copy.path(), &entries, &whole, &what) {
                true => {
                    reported += 1;
                    // After a repair, each index is equal too or reported as damaged.
                    if repair(copy.path(), false).is_ok() {
                        is_reported(copy.path(), &entries, &whole, &what);
                    }
                }
                false => harmless += 1,
            }
        }
        if is_mended(name) {
            assert_eq!(reported, before.0, "{}", name.display());
            mended += 1;
        }
        if name.extension().is_some_and(|kind| kind == "jnl") {
            assert!(reported > before.0, "{}", name.display());
        }
        println!(
            "{}: {} bytes, {} flips reported, {} harmless",
            name.display(),
            bytes.len(),
            reported - before.0,
            harmless - before.1
        );
    }
    assert!(reported > 0 && harmless > 0);
    assert!(mended >= 6, "{mended} files are mended");
}
