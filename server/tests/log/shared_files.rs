//! The store restores the small files that every index depends on when they are damaged or missing.

use std::{fs, path::Path};

use wayfold_server::log::{Catalogue, FjallLog, LogError, PointStore};

use super::{
    all_points,
    copied::copied,
    disk::{append_synced, open},
    entry,
    tables::move_to_tables,
};

const CURRENTS: [&str; 2] = ["store/keyspaces/0/current", "store/keyspaces/1/current"];

/// A closed log with two revisions of one index, most of it in tables.
fn fill(directory: &Path) -> wayfold_server::log::Entry {
    let arm = entry("arm");
    let log = open(directory);
    log.create(arm.clone()).unwrap();
    append_synced(&log, arm.uid, 1);
    drop(log);
    // fjall writes another list of its tables.
    move_to_tables(directory);
    append_synced(&open(directory), arm.uid, 2);
    arm
}

fn point_count(log: &FjallLog, entry: &wayfold_server::log::Entry) -> usize {
    all_points(&*log.view(entry.uid).unwrap()).len()
}

/// The list that `current` names.
fn list(directory: &Path, current: &str) -> String {
    let bytes = fs::read(directory.join(current)).unwrap();
    let number = u64::from_le_bytes(bytes[..8].try_into().unwrap());
    current.replace("current", &format!("v{number}"))
}

#[test]
fn every_flipped_bit_and_every_missing_file_is_mended() {
    let directory = tempfile::tempdir().unwrap();
    let arm = fill(directory.path());
    let mut files = vec!["store/version".to_owned()];
    for current in CURRENTS {
        files.extend([current.to_owned(), list(directory.path(), current)]);
    }
    for file in files {
        let whole = fs::read(directory.path().join(&file)).unwrap();
        for at in (0..whole.len()).step_by(7).map(Some).chain([None]) {
            println!("{file}, byte {at:?}");
            let copy = copied(directory.path());
            let path = copy.path().join(&file);
            match at {
                Some(at) => {
                    let mut flipped = whole.clone();
                    flipped[at] ^= 1 << (at % 8);
                    fs::write(&path, flipped).unwrap();
                }
                None => fs::remove_file(&path).unwrap(),
            }
            let log = open(copy.path());
            assert_eq!(point_count(&log, &arm), 2);
            assert_eq!(log.lost(), []);
        }
    }
}

/// Flips every bit of `current`, with and without the copy: the rest of `current` proves the list.
#[test]
fn a_flipped_bit_of_current_needs_no_copy() {
    let directory = tempfile::tempdir().unwrap();
    let arm = fill(directory.path());
    fs::remove_file(directory.path().join("manifest-copy")).unwrap();
    for file in CURRENTS {
        for at in 0..25 {
            let copy = copied(directory.path());
            let path = copy.path().join(file);
            let mut flipped = fs::read(&path).unwrap();
            flipped[at] ^= 1 << (at % 8);
            fs::write(&path, flipped).unwrap();
            assert_eq!(
                point_count(&open(copy.path()), &arm),
                2,
                "{file}, byte {at}"
            );
        }
    }
}

/// fjall would remove the tables that an older list does not name.
#[test]
fn a_copy_that_is_older_than_the_tables_is_not_put_back() {
    let directory = tempfile::tempdir().unwrap();
    let arm = fill(directory.path());
    let older = list(directory.path(), CURRENTS[1]);
    move_to_tables(directory.path());
    let newer = list(directory.path(), CURRENTS[1]);
    assert_ne!(older, newer);
    let whole = fs::read(directory.path().join(CURRENTS[1])).unwrap();
    for left in [&whole[..20], &[0; 25], &[]] {
        let copy = copied(directory.path());
        let current = copy.path().join(CURRENTS[1]);
        fs::write(&current, left).unwrap();
        let log = open(copy.path());
        let failure = log.failure().unwrap();
        assert!(matches!(failure, LogError::Unopened { .. }), "{failure}");
        assert_eq!(fs::read(&current).unwrap(), left);
        assert!(copy.path().join(&newer).exists());
        // The original file repairs the store, because the failed start changed nothing.
        fs::write(&current, &whole).unwrap();
        log.reopen().unwrap();
        assert_eq!(point_count(&log, &arm), 2);
    }
}

#[test]
fn a_damaged_copy_is_not_used_and_is_written_anew() {
    let directory = tempfile::tempdir().unwrap();
    let arm = fill(directory.path());
    let path = directory.path().join("manifest-copy");
    let whole = fs::read(&path).unwrap();
    for at in (0..whole.len()).step_by(11) {
        let copy = copied(directory.path());
        let path = copy.path().join("manifest-copy");
        let mut flipped = whole.clone();
        flipped[at] ^= 1;
        fs::write(&path, flipped).unwrap();
        let current = copy.path().join(CURRENTS[1]);
        let named = fs::read(&current).unwrap();
        fs::remove_file(&current).unwrap();
        let log = open(copy.path());
        assert!(matches!(log.failure(), Some(LogError::Unopened { .. })));
        fs::write(&current, named).unwrap();
        log.reopen().unwrap();
        assert_eq!(point_count(&log, &arm), 2);
        drop(log);
        assert_eq!(fs::read(&path).unwrap(), whole);
    }
}
