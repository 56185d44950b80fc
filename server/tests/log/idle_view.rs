//! A view of an idle index does not make the store keep data that other indices overwrite.

use std::{fs, path::Path, sync::Arc};

use bytes::Bytes;
use wayfold_index::PointRef;
use wayfold_server::log::{Catalogue, Effects, FjallLog, Journal, Outcome, PointStore, Uid};

use super::{
    all_points,
    disk::{append_synced, open},
    effects, entry, retention, submit,
};

/// Mebibytes that the busy index writes, unless the environment variable `IDLE_VIEW_MIB` sets another number.
const MIB: u64 = 320;

const PAYLOAD_BYTES: usize = 1024 * 1024;

/// The busy index holds one point of [`PAYLOAD_BYTES`] and one record; fjall keeps up to four memtables of 64 MiB.
const MAX_TABLE_BYTES: u64 = 128 * 1024 * 1024;

/// Overwrites the payload of one point in `revisions` records, of which the log keeps only the newest.
fn overwrite(log: &FjallLog, uid: Uid, revisions: u64) {
    for revision in 1..=revisions {
        let mut effects = Effects::new(1);
        let point = PointRef {
            id: 7,
            tag: 0,
            revision,
            row: &[0.5],
        };
        let payload = Bytes::from(vec![revision as u8; PAYLOAD_BYTES]);
        effects.store(point, Outcome::Inserted, payload);
        let record = submit(log, uid, revision - 1, effects).unwrap();
        drop(log.apply(uid, &[record]).unwrap());
        log.trim(uid, &retention(0)).unwrap();
    }
}

/// Bytes of all files under `directory`.
fn disk_bytes(directory: &Path) -> u64 {
    let entries = fs::read_dir(directory).unwrap().map(Result::unwrap);
    let bytes = entries.map(|entry| match entry.path().is_dir() {
        true => disk_bytes(&entry.path()),
        // fjall may remove the file meanwhile.
        false => entry.metadata().map_or(0, |metadata| metadata.len()),
    });
    bytes.sum()
}

/// Resident bytes of this process.
fn resident_bytes() -> u64 {
    let statm = fs::read_to_string("/proc/self/statm").unwrap();
    4096 * statm.split(' ').nth(1).unwrap().parse::<u64>().unwrap()
}

#[test]
fn a_view_of_an_idle_index_pins_nothing_that_other_indices_overwrite() {
    let mib = std::env::var("IDLE_VIEW_MIB").map_or(MIB, |mib| mib.parse().unwrap());
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path());
    let (idle, busy) = (entry("idle"), entry("busy"));
    for entry in [&idle, &busy] {
        log.create(entry.clone()).unwrap();
    }
    append_synced(&log, idle.uid, 1);
    let view = log.view(idle.uid).unwrap();
    let before = all_points(&*view);
    overwrite(&log, busy.uid, mib);
    let tables = disk_bytes(&directory.path().join("store/keyspaces"));
    println!(
        "{mib} MiB written: {} MiB of tables, {} MiB resident",
        tables >> 20,
        resident_bytes() >> 20
    );
    assert!(tables <= MAX_TABLE_BYTES, "{tables} bytes of tables");
    assert_eq!(all_points(&*view), before);
}

/// The view follows no later revision, whether it was read before that revision or not.
#[test]
fn a_view_stays_at_its_revision_when_its_index_is_written_and_deleted() {
    let directory = tempfile::tempdir().unwrap();
    let log = open(directory.path());
    let arm = entry("arm");
    log.create(arm.clone()).unwrap();
    let mut views = Vec::new();
    for revision in 1..=5 {
        append_synced(&log, arm.uid, revision);
        let view = log.view(arm.uid).unwrap();
        let shared = log.view(arm.uid).unwrap();
        if revision % 2 == 0 {
            assert_eq!(all_points(&*shared).len() as u64, revision);
        }
        views.push(view);
    }
    // This removes a point that every view holds.
    let removed: Vec<u64> = (1..=5).collect();
    submit(&log, arm.uid, 5, effects(6, &[9], &removed)).unwrap();
    views.push(log.view(arm.uid).unwrap());
    log.delete(arm.uid).unwrap();
    for (view, revision) in views.iter().zip(1..) {
        assert_eq!(view.revision(), revision);
        let ids: Vec<u64> = all_points(&**view).into_keys().collect();
        let expected: Vec<u64> = if revision < 6 {
            (1..=revision).collect()
        } else {
            vec![9]
        };
        assert_eq!(ids, expected);
        let point = view.get(ids[0]).unwrap().map(|point| Arc::clone(&point));
        assert_eq!(point.unwrap().modified, if revision < 6 { 1 } else { 6 });
    }
}
