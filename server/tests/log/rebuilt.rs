//! A store with a damaged block. A start serves the readable content and rebuilds nothing. A repair keeps every index
//! that can be read whole, and these stay writable.

use std::{
    fs,
    path::{Path, PathBuf},
    slice,
    sync::Arc,
};

use bytes::Bytes;
use wayfold_server::log::{
    Catalogue, Durability, Effects, Entry, FjallLog, LogError, Operation, PointStore, RepairError,
    Uid, repair,
};

use super::{
    all_points,
    copied::copied,
    disk::{append_synced, open, open_at, with_batch},
    effects, entry, retention, submit, synced,
    tables::{self, flip, in_tables, move_to_tables, open_store, payload, places, table_files},
};

/// The bytes of a payload, which fill several blocks, so that fjall soon begins another table.
const PAYLOAD: usize = 32 * 1024;
const BURST_BYTES: usize = 1024 * 1024;

/// Stores the point with the id of the next revision, which it returns once it is durable.
fn grow(log: &FjallLog, uid: Uid, payload: Bytes) -> Result<u64, LogError> {
    synced(log, uid, tables::grow(log, uid, payload)?)
}

/// Creates two indices that are wholly in tables: `arm` with 20 points with payloads, `base` with one revision, which
/// opens a session. fjall will rewrite the tables with the next one or two.
fn fill(directory: &Path) -> [Entry; 2] {
    let log = open(directory);
    let base = tables::created(&log, "base");
    let opening = with_batch(effects(1, &[1], &[]), (1, 0), 1000..1010, &[]);
    submit(&log, base.uid, 0, opening).unwrap();
    drop(log);
    [
        in_tables(directory, "arm", &[1..=10, 11..=15, 16..=20], PAYLOAD),
        base,
    ]
}

/// Flips a bit in the middle of the payload of point 10 of `arm`, in the point and in the record.
fn damage(directory: &Path) {
    for (table, at) in found(directory) {
        flip(&table, at);
    }
}

/// Flips a bit of the payload in the record alone, which comes after the point.
fn damage_last(directory: &Path) {
    let (table, at) = found(directory).pop().unwrap();
    flip(&table, at);
}

fn found(directory: &Path) -> Vec<(PathBuf, usize)> {
    let found = places(directory, &payload(10, PAYLOAD)[PAYLOAD / 2..][..32]);
    assert_eq!(found.len(), 2);
    found
}

fn damaged(log: &FjallLog, entry: &Entry) {
    for error in [
        log.view(entry.uid).err().unwrap(),
        submit(log, entry.uid, 20, Effects::new(0)).unwrap_err(),
    ] {
        assert!(matches!(error, LogError::Unreadable { .. }), "{error}");
    }
}

/// Lets fjall rewrite all of its files by holding nothing of the store.
fn can_be_rewritten(directory: &Path) {
    open_store(directory).1.major_compact().unwrap();
}

#[test]
fn a_damaged_block_costs_its_index_and_the_others_are_written_on() {
    let directory = tempfile::tempdir().unwrap();
    let [arm, base] = fill(directory.path());
    damage(directory.path());
    let log = open(directory.path());
    let sessions = log.view(base.uid).unwrap().sessions().clone();
    drop(log);
    assert_eq!((sessions.len(), sessions.block_count()), (1, 1));
    let kept = directory.path().join("store.damaged-1");
    for _ in 0..2 {
        let log = open(directory.path());
        damaged(&log, &arm);
        let why = log.view(arm.uid).err().unwrap().to_string();
        assert!(why.contains("`wayfold-server repair`"), "{why}");
        assert_eq!(all_points(&*log.view(base.uid).unwrap()).len(), 1);
        let in_use = repair(directory.path(), false).unwrap_err();
        assert!(matches!(in_use, RepairError::Directory(_)), "{in_use}");
        drop(log);
        let report = repair(directory.path(), true).unwrap();
        assert!(report.damage.is_some() && report.needed_bytes > 0);
        let lost: Vec<_> = report.lost.iter().map(|(name, _)| &**name).collect();
        assert_eq!(
            (&lost[..], report.whole, report.kept),
            (&["arm"][..], 1, None)
        );
        assert!(!kept.exists());
    }
    let report = repair(directory.path(), false).unwrap();
    assert_eq!((report.lost.len(), report.whole), (1, 1));
    assert_eq!(report.kept.as_ref(), Some(&kept));
    assert_eq!(repair(directory.path(), false).unwrap().damage, None);
    for revision in 2..4 {
        let log = open(directory.path());
        damaged(&log, &arm);
        assert_eq!(log.view(base.uid).unwrap().sessions(), &sessions);
        append_synced(&log, base.uid, revision);
        assert_eq!(
            all_points(&*log.view(base.uid).unwrap()).len(),
            revision as usize
        );
        drop(log);
        can_be_rewritten(directory.path());
        assert!(kept.exists());
        assert!(!directory.path().join("store.damaged-2").exists());
    }
    let log = open(directory.path());
    let why = log.view(arm.uid).err().unwrap().to_string();
    for part in ["revisions 1 to 20", "store.damaged-N", "restore the index"] {
        assert!(why.contains(part), "{why}");
    }
    log.delete(arm.uid).unwrap();
    drop(log);
    assert_eq!(open(directory.path()).indexes().unwrap(), [base]);
}

/// The content of the damaged block.
#[derive(Clone, Copy, Debug, PartialEq)]
enum BlockContent {
    /// A point of `arm`.
    Point,
    /// A record of `arm` that has been trimmed.
    Past,
    /// The remains of a deleted index.
    Deleted,
}

/// fjall finds the damage while the log is written, even if no read asks for the block. Then no write succeeds until a
/// repair, and reads go on.
#[test]
fn a_repair_loses_only_the_content_of_a_block_damaged_while_the_log_was_open() {
    for held in [
        BlockContent::Point,
        BlockContent::Past,
        BlockContent::Deleted,
    ] {
        let directory = tempfile::tempdir().unwrap();
        let [arm, base] = fill(directory.path());
        let log = open(directory.path());
        match held {
            BlockContent::Point => {}
            BlockContent::Past => {
                log.trim(arm.uid, &retention(0)).unwrap();
                append_synced(&log, arm.uid, 21);
            }
            BlockContent::Deleted => log.delete(arm.uid).unwrap(),
        }
        match held {
            BlockContent::Past => damage_last(directory.path()),
            BlockContent::Point | BlockContent::Deleted => damage(directory.path()),
        }
        let mut revision = 1;
        let much = Bytes::from(vec![0; BURST_BYTES]);
        let failure = loop {
            assert!(revision < 500, "the block was never rewritten");
            match grow(&log, base.uid, much.clone()) {
                Ok(grown) => revision = grown,
                Err(error) => break error,
            }
        };
        println!("{held:?}, after {revision} revisions: {failure}");
        assert_eq!(log.failure(), Some(failure));
        let points = |entry: &Entry| all_points(&*log.view(entry.uid).unwrap()).len() as u64;
        assert!(points(&base) >= revision);

        // The reopened store can be read but not written.
        log.reopen().unwrap();
        for _ in 0..2 {
            let refused = log.failure().unwrap();
            let is_damaged = matches!(refused, LogError::DamagedStore { .. });
            assert!(is_damaged, "{refused}");
            assert!(refused.to_string().contains("`wayfold-server repair`"));
            let append = grow(&log, base.uid, much.clone());
            assert_eq!(append, Err(refused.clone()));
            assert_eq!(log.reopen(), Err(refused));
            assert!(points(&base) >= revision);
        }
        drop(log);
        let report = repair(directory.path(), false).unwrap();
        assert!(report.damage.is_some());
        let log = open(directory.path());
        let points = |entry: &Entry| all_points(&*log.view(entry.uid).unwrap()).len() as u64;
        match held {
            BlockContent::Point => damaged(&log, &arm),
            BlockContent::Past => assert_eq!(points(&arm), 21),
            BlockContent::Deleted => assert_eq!(log.indexes().unwrap(), slice::from_ref(&base)),
        }
        let head = log.view(base.uid).unwrap().revision();
        assert!(head >= revision);
        grow(&log, base.uid, much).unwrap();
        assert_eq!(points(&base), head + 1);
        drop(log);
        can_be_rewritten(directory.path());
    }
}

/// A flipped bit anywhere in a table but at its very end loses some indices; the others live on.
#[test]
fn no_block_of_a_table_costs_all_indices() {
    const INDICES: u64 = 120;
    const REVISIONS: u64 = 3;
    for durability in [Durability::Fsync, Durability::Os] {
        let directory = tempfile::tempdir().unwrap();
        let log = open_at(directory.path(), durability);
        let entries: Vec<_> = (0..INDICES)
            .map(|at| entry(&format!("index-{at}")))
            .collect();
        for entry in &entries {
            log.create(entry.clone()).unwrap();
            for revision in 1..=REVISIONS {
                let mut effects = effects(revision, &[revision], &[]);
                effects.set_operation(Some(Arc::new(Operation {
                    id: format!("operation {revision}"),
                    fingerprint: [7; 32],
                    response: Bytes::new(),
                })));
                submit(&log, entry.uid, revision - 1, effects).unwrap();
            }
        }
        drop(log);
        move_to_tables(directory.path());
        let tables = table_files(directory.path());
        let name = tables[0].strip_prefix(directory.path()).unwrap();
        let bytes = fs::read(&tables[0]).unwrap();
        let (mut all_lost, flips) = (Vec::new(), 8);
        for at in (0..flips).map(|flip| bytes.len() * flip / flips) {
            let copy = copied(directory.path());
            flip(&copy.path().join(name), at);
            let log = open_at(copy.path(), durability);
            let unreadable = |log: &FjallLog| -> Vec<_> {
                let lost = entries.iter();
                lost.filter(|entry| log.view(entry.uid).is_err()).collect()
            };
            let at_start = unreadable(&log);
            drop(log);
            let repaired = repair(copy.path(), false).is_ok();
            let log = open_at(copy.path(), durability);
            let lost = unreadable(&log);
            println!("{} lost at the start, repaired: {repaired}", at_start.len());
            println!(
                "{durability:?}, byte {at} of {}: {} lost",
                bytes.len(),
                lost.len()
            );
            for lost in &lost {
                let listed = log.indexes().unwrap_or_default().contains(lost);
                let gone = log.lost().iter().any(|gone| gone.uid == lost.uid);
                assert!(
                    listed || gone || log.failure().is_some(),
                    "nothing tells of it"
                );
            }
            if lost.len() == entries.len() {
                all_lost.push(at);
                continue;
            }
            let were_lost = lost.iter().all(|lost| at_start.contains(lost));
            assert!(were_lost, "a repair loses nothing that can be read");
            let new = entry("new");
            log.create(new.clone()).unwrap();
            drop(log);
            let log = open_at(copy.path(), durability);
            assert_eq!(log.view(new.uid).unwrap().revision(), 0);
            for entry in entries.iter().filter(|entry| !lost.contains(entry)) {
                let points = all_points(&*log.view(entry.uid).unwrap());
                assert_eq!(points.len() as u64, REVISIONS);
            }
        }
        // fjall opens no table whose end is damaged.
        let end = bytes.len() * 9 / 10;
        assert!(all_lost.iter().all(|at| *at > end), "{all_lost:?}");
    }
}

/// The room that it takes is free for the next one.
#[test]
fn a_store_that_a_repair_did_not_finish_is_removed() {
    let directory = tempfile::tempdir().unwrap();
    drop(open(directory.path()));
    let unfinished = directory.path().join("store.new");
    let checks: [fn(&Path); 2] = [
        |directory| drop(open(directory)),
        |directory| drop(repair(directory, true).unwrap()),
    ];
    for check in checks {
        fs::create_dir(&unfinished).unwrap();
        fs::write(unfinished.join("junk"), "junk").unwrap();
        check(directory.path());
        assert!(!unfinished.exists());
    }
}

/// Power is lost once the new store is whole, before or after the damaged store is moved away.
#[test]
fn a_rebuilt_store_takes_its_place_at_the_next_start() {
    let directory = tempfile::tempdir().unwrap();
    let [arm, base] = fill(directory.path());
    damage(directory.path());
    repair(directory.path(), false).unwrap();
    let [store, rebuilt, kept] =
        ["store", "store.rebuilt", "store.damaged-1"].map(|name| directory.path().join(name));
    let is_whole = || {
        let log = open(directory.path());
        damaged(&log, &arm);
        assert_eq!(log.view(base.uid).unwrap().revision(), 1);
        assert!(kept.exists() && !rebuilt.exists());
    };
    fs::rename(&store, &rebuilt).unwrap();
    is_whole();
    fs::rename(&store, &rebuilt).unwrap();
    fs::rename(&kept, &store).unwrap();
    is_whole();
}
