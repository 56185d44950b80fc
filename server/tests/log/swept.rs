//! The disk of deleted indices.

use std::{
    fs, thread,
    time::{Duration, Instant},
};

use wayfold_server::log::{Catalogue, PointStore};

use super::{
    all_points,
    disk::open,
    tables::{in_tables, open_store, table_files},
};

const MIB: usize = 1024 * 1024;

/// Its tables are dropped, but for those with keys of others too: 34 MiB of 96. The files go at once, or at the next start
/// if a view still reads them. Nothing of another index is lost.
#[test]
fn a_deleted_index_gives_its_disk_back() {
    for is_viewed in [false, true] {
        let directory = tempfile::tempdir().unwrap();
        let other = in_tables(directory.path(), "other", &[1..=3], 10);
        let large = in_tables(directory.path(), "large", &[1..=48], MIB);
        {
            let (_database, keyspace) = open_store(directory.path());
            keyspace.major_compact().unwrap();
        }
        let log = open(directory.path());
        let disk = || -> u64 {
            let files = table_files(directory.path()).into_iter();
            files
                .filter_map(|file| fs::metadata(file).ok())
                .map(|it| it.len())
                .sum()
        };
        let list = || fs::read(directory.path().join("store/keyspaces/1/current")).unwrap();
        let (most, list_before) = (disk() - 30 * MIB as u64, list());
        let view = is_viewed.then(|| log.view(large.uid).unwrap());
        log.delete(large.uid).unwrap();
        if let Some(view) = view {
            eventually(|| list() != list_before);
            assert_eq!(all_points(&*view).len(), 48);
        } else {
            eventually(|| disk() < most);
        }
        drop(log);
        let log = open(directory.path());
        assert!(disk() < most);
        let names: Vec<_> = log
            .indexes()
            .unwrap()
            .into_iter()
            .map(|it| it.name)
            .collect();
        assert_eq!(names, ["other"]);
        assert_eq!(all_points(&*log.view(other.uid).unwrap()).len(), 3);
    }
}

fn eventually(holds: impl Fn() -> bool) {
    let began = Instant::now();
    while !holds() {
        assert!(began.elapsed() < Duration::from_secs(60));
        thread::yield_now();
    }
}
