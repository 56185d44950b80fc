//! The latency of single inserts and queries while an index is loaded and its levels merge.

use std::{
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc::{self, RecvTimeoutError},
    },
    thread,
    time::{Duration, Instant},
};

use tokio::time::interval;
use wayfold_tests::{
    States, Stubs,
    figures::{quantile_ms, resident_bytes},
    knn_request, measuring,
    report::Report,
};

use crate::{
    INDEX, K, SPACE, WIDTH,
    base_directory::{AppendFile, BaseDirectory},
    service::insertion,
};

const BATCH: usize = 1_000;
/// A call that takes longer than this counts as a pause.
const PAUSE: Duration = Duration::from_millis(20);
/// A sync of the witness that takes this long explains a pause at the same time.
const SLOW_SYNC: Duration = Duration::from_millis(10);
/// The interval between syncs of the witness.
const SYNC_INTERVAL: Duration = Duration::from_millis(2);

/// The readings of the memory after the load, one a second: within them all levels are merged.
const MEMORY_READINGS: u32 = 30;

/// The start and the duration of an event.
type TimedEvent = (Instant, Duration);

pub(crate) async fn measure(base: &BaseDirectory, points: usize, report: &mut Report) {
    let title = format!("while {points} points are loaded in batches of {BATCH}, over gRPC");
    report.section(&title, "");
    for durable in [true, false] {
        let directory = base.create();
        let data = directory.path().join("data");
        let (data, on) = if durable {
            (data.to_string_lossy().into_owned(), "on disk")
        } else {
            ("memory".into(), "in memory")
        };
        let server = measuring::server(&data);
        let process = server.process().id();
        let before = resident_bytes(process);
        Stubs::connect(server.uri())
            .await
            .create(INDEX, SPACE)
            .await;
        let (stop, stopped) = mpsc::channel();
        let beside = directory.path().to_owned();
        let witness = thread::spawn(move || witness(&beside, &stopped));
        let loaded = Arc::new(AtomicBool::new(false));
        let inserts = tokio::spawn(ask(
            Stubs::connect(server.uri()).await,
            false,
            loaded.clone(),
        ));
        let queries = tokio::spawn(ask(
            Stubs::connect(server.uri()).await,
            true,
            loaded.clone(),
        ));
        let rate = load(Stubs::connect(server.uri()).await, points).await;
        loaded.store(true, Ordering::Relaxed);
        let (inserts, queries) = (inserts.await, queries.await);
        drop(stop);
        let syncs = witness.join().expect("a witness");
        report.note(&format!("{on}: points loaded a second"), rate, "/s");
        let inserts = inserts.expect("inserts");
        let stored = (points.next_multiple_of(BATCH) + inserts.len()) as f64;
        let after = [
            ("right after the load", resident_bytes(process)),
            ("the least within 30 s", least_resident_bytes(process).await),
        ];
        for (moment, after) in after {
            // Only some systems report it.
            if let Some((before, after)) = before.zip(after) {
                let what = format!("{on}: resident bytes a point, {moment}");
                report.note(&what, after.saturating_sub(before) as f64 / stored, "");
            }
        }
        for (what, taken) in [
            ("single inserts", inserts),
            ("k = 10 queries", queries.expect("queries")),
        ] {
            tell(report, &format!("{on}: {what}"), &taken);
            let pauses: Vec<_> = taken.iter().filter(|taken| taken.1 > PAUSE).collect();
            let excused = pauses.iter().filter(|pause| is_excused(pause, &syncs));
            report.note(&format!("{on}: {what} over 20 ms"), pauses.len() as f64, "");
            report.note(
                "  of these beside a slow sync of the witness",
                excused.count() as f64,
                "",
            );
        }
        tell(
            report,
            &format!("{on}: the witness's own 4 KiB appends"),
            &syncs,
        );
    }
}

fn tell(report: &mut Report, what: &str, taken: &[TimedEvent]) {
    let mut sorted: Vec<_> = taken.iter().map(|taken| taken.1).collect();
    sorted.sort();
    for (name, q) in [("p50", 0.5), ("p99", 0.99), ("p99.9", 0.999), ("max", 1.0)] {
        report.note(&format!("{what}, {name}"), quantile_ms(&sorted, q), "ms");
    }
}

fn is_excused(pause: &TimedEvent, syncs: &[TimedEvent]) -> bool {
    syncs
        .iter()
        .any(|sync| sync.1 >= SLOW_SYNC && sync.0 < pause.0 + pause.1 && pause.0 < sync.0 + sync.1)
}

/// Appends and syncs on the same disk until a message stops it. A slow sync here is due to the disk.
fn witness(directory: &Path, stopped: &mpsc::Receiver<()>) -> Vec<TimedEvent> {
    let mut file = AppendFile::new(directory);
    let mut taken = Vec::new();
    while stopped.recv_timeout(SYNC_INTERVAL) == Err(RecvTimeoutError::Timeout) {
        let began = Instant::now();
        taken.push((began, file.append(&[0; 4096])));
    }
    taken
}

/// Points per second.
async fn load(mut stubs: Stubs, points: usize) -> f64 {
    let mut states = States::new(SPACE.parse().expect("a space"), 0);
    let mut in_calls = Duration::ZERO;
    for _ in 0..points.div_ceil(BATCH) {
        let request = insertion(&states.rows(BATCH), None);
        let began = Instant::now();
        stubs.insert(request).await;
        in_calls += began.elapsed();
    }
    points as f64 / in_calls.as_secs_f64()
}

/// Makes calls of one state, one in flight, until the load ends.
async fn ask(mut stubs: Stubs, queries: bool, loaded: Arc<AtomicBool>) -> Vec<TimedEvent> {
    let mut states = States::new(SPACE.parse().expect("a space"), 1 + u64::from(queries));
    let mut taken = Vec::new();
    while !loaded.load(Ordering::Relaxed) {
        let row = states.row();
        let began;
        if queries {
            let request = knn_request(INDEX, &row, WIDTH, K);
            began = Instant::now();
            stubs.points.knn(request).await.expect("an answer");
        } else {
            let request = insertion(&row, None);
            began = Instant::now();
            stubs.insert(request).await;
        }
        taken.push((began, began.elapsed()));
    }
    taken
}

/// The least memory of a process that rests.
async fn least_resident_bytes(process: u32) -> Option<u64> {
    let (mut seconds, mut least) = (interval(Duration::from_secs(1)), None);
    for _ in 0..MEMORY_READINGS {
        seconds.tick().await;
        least = least.into_iter().chain(resident_bytes(process)).min();
    }
    least
}
