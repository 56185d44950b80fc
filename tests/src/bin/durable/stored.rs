//! A million stored points: the time of a restart, and the disk space.

use std::{
    fs,
    path::Path,
    time::{Duration, Instant},
};

use fjall::{Database, Keyspace, KeyspaceCreateOptions, PersistMode, Readable};
use wayfold_index::{Forest, ForestOptions, Points, Space};
use wayfold_server::log::Durability;
use wayfold_tests::{
    Signal, States, Stubs,
    figures::median,
    measuring,
    report::{Goal, Report},
};

use crate::{
    INDEX, SPACE, WIDTH,
    base_directory::{BaseDirectory, used},
    service::{LocalService, WINDOW_BYTES, insertion},
    shape::{KEYSPACE, STORE},
};

const BATCH: usize = 1_000;
/// The numbers of a point: its coordinates, id, tag and revision.
const POINT_BYTES: usize = 8 * (WIDTH + 3);
/// The offset of the coordinates in the stored value of a point: after two revisions, the tag and the width.
const STATE_OFFSET: usize = 26;

pub(crate) async fn measure(
    base: &BaseDirectory,
    points: usize,
    rounds: usize,
    report: &mut Report,
) {
    let directory = base.create();
    let data = directory.path();
    fill(data, points).await;
    let (all, files) = used(data);
    let (journals, _) = journals(&data.join(STORE));

    report.section(&format!("restart with {points} points"), "scan + build");
    let (mut ours, mut bare) = (Vec::new(), Vec::new());
    for _ in 0..rounds {
        bare.push(scan_and_build(&data.join(STORE), points).as_secs_f64());
        let began = Instant::now();
        let hosting = LocalService::open(data, Durability::Fsync, WINDOW_BYTES);
        ours.push(began.elapsed().as_secs_f64());
        drop(hosting);
    }
    report.ratio(
        "from opening to ready",
        median(ours),
        median(bare),
        "s",
        Goal::AtMost(2.0),
    );

    report.section(&format!("disk, {points} points"), "the numbers");
    report.note(
        "the whole directory as it was left",
        per(all, points),
        "bytes/point",
    );
    report.note("  files", files as f64, "");
    report.note("  of it journals", per(journals, points), "bytes/point");
    let (database, keyspace) = open(&data.join(STORE));
    let snapshot = database.snapshot();
    let alone = base.create();
    let (copy, copied) = open(alone.path());
    let mut window = 0;
    for pair in snapshot.iter(&keyspace) {
        let (key, value) = pair.into_inner().expect("a pair");
        if key.first() == Some(&b'p') {
            copied.insert(key, value).expect("room");
        } else {
            window += key.len() + value.len();
        }
    }
    report.note(
        "  records, operations and heads in it",
        window as f64 / points as f64,
        "bytes/point",
    );
    drop(snapshot);
    keyspace.rotate_memtable_and_wait().expect("room");
    keyspace.major_compact().expect("room");
    drop((keyspace, database));
    let (compacted, _) = used(data);
    let (left, _) = self::journals(&data.join(STORE));
    report.note(
        "the whole but journals, compacted",
        per(compacted - left, points),
        "bytes/point",
    );

    copied.rotate_memtable_and_wait().expect("room");
    copied.major_compact().expect("room");
    copy.persist(PersistMode::SyncAll).expect("a sync");
    drop((copied, copy));
    let (bytes, _) = used(alone.path());
    let (journal, _) = self::journals(alone.path());
    report.ratio(
        "the points alone, compacted",
        per(bytes - journal, points),
        POINT_BYTES as f64,
        "bytes/point",
        Goal::AtMost(1.3),
    );
}

/// Stores `points` points in a data directory, as a server does.
async fn fill(data: &Path, points: usize) {
    let server = measuring::server(&data.to_string_lossy());
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create(INDEX, SPACE).await;
    let mut states = States::new(SPACE.parse().expect("a space"), 0);
    for _ in 0..points.div_ceil(BATCH) {
        stubs.insert(insertion(&states.rows(BATCH), None)).await;
    }
    drop(stubs);
    let stopped = server.stop(Signal::Terminate);
    assert!(stopped.status.success(), "{}", stopped.stderr);
}

fn per(bytes: u64, points: usize) -> f64 {
    bytes as f64 / points as f64
}

fn open(store: &Path) -> (Database, Keyspace) {
    let database = Database::builder(store).open().expect("a store");
    let keyspace = database.keyspace(KEYSPACE, KeyspaceCreateOptions::default);
    let keyspace = keyspace.expect("a keyspace");
    (database, keyspace)
}

/// The bytes and the number of a store's journal files.
fn journals(store: &Path) -> (u64, usize) {
    let files = fs::read_dir(store).expect("a directory");
    let journals = files.filter_map(|file| {
        let path = file.expect("an entry").path();
        path.extension()
            .is_some_and(|end| end == "jnl")
            .then(|| crate::base_directory::bytes_of(&path))
    });
    journals.fold((0, 0), |(bytes, files), more| (bytes + more, files + 1))
}

/// The time without our log: opening the store, reading its points, and building a forest from them.
fn scan_and_build(store: &Path, points: usize) -> Duration {
    let began = Instant::now();
    let (database, keyspace) = open(store);
    let space: Space = SPACE.parse().expect("a space");
    let mut rows = Points::new(WIDTH);
    let snapshot = database.snapshot();
    for pair in snapshot.prefix(&keyspace, "p") {
        let (key, value) = pair.into_inner().expect("a pair");
        let id = key.last_chunk().map_or(0, |id| u64::from_be_bytes(*id));
        let state: [f64; WIDTH] = std::array::from_fn(|at| {
            let bytes = value[STATE_OFFSET + 8 * at..].first_chunk();
            f64::from_le_bytes(*bytes.expect("a state"))
        });
        rows.push(id, 0, 1, &state);
    }
    assert_eq!(rows.len(), points);
    let mut forest = Forest::new(space.clone(), ForestOptions::for_space(&space));
    forest.apply(1, &rows, &[]).expect("canonical states");
    forest.settle();
    began.elapsed()
}
