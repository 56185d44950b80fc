//! The time from an insert until the copy of another process has the point.

use std::{
    env,
    path::Path,
    process::ExitCode,
    time::{Duration, Instant, SystemTime},
};

use tokio::time::{MissedTickBehavior, interval};
use wayfold::{Index, InsertOptions, Search};
use wayfold_index::{ReadRevision, Space};
use wayfold_tests::{
    Process, ServerProcess, States, figures::processor_seconds, measuring, report::Report,
};

use crate::{Arguments, SE3, base_directory::AppendFile};

/// The role of a process that writes.
pub(crate) const WRITER: &str = "writer";

/// The writers insert what is due, and the reader looks for what came, this often.
const TICK: Duration = Duration::from_millis(1);
/// The longest time without a new point.
const MAX_SILENCE: Duration = Duration::from_secs(60);
/// The number of appends, before and after.
const APPENDS: usize = 1_000;

pub(crate) fn measure(arguments: &Arguments, directory: &Path, writers: u32, report: &mut Report) {
    let server = measuring::server(&directory.join("data").to_string_lossy());
    let space: Space = SE3.parse().expect("a space");
    let index = Index::shared(server.uri(), "arm").create(&space).open();
    let index = index.expect("a shared index");
    let mut file = AppendFile::new(directory);
    let mut syncs: Vec<_> = (0..APPENDS).map(|_| file.append(&[0; 4_096])).collect();
    let rate = (arguments.rate / writers).to_string();
    let seconds = arguments.seconds.to_string();
    let mut processes: Vec<Process> = (0..writers)
        .map(|seed| {
            let seed = seed.to_string();
            let mut process =
                measuring::spawn(WRITER, &[server.uri(), rate.as_str(), &seconds, &seed]);
            assert_eq!(process.line().as_deref(), Some("ready"));
            process
        })
        .collect();
    let at_first = Spent::now(&server, &processes);
    let origin = vec![0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    // Before the first insert, so that no point is missed.
    let empty = index.search(origin, &Search::k(1)).expect("an answer");
    processes.iter_mut().for_each(|process| process.say("go"));
    let count = (arguments.rate / writers * writers * arguments.seconds) as usize;
    let mut delays = follow(&index, empty.read_revision, count);
    let at_last = Spent::now(&server, &processes);
    let pending = processes.iter_mut().map(|process| {
        let line = process.line().expect("the most pending writes");
        line.parse::<f64>().expect("a number")
    });
    let pending = pending.fold(0.0, f64::max);
    for process in processes {
        assert!(process.finish().status.success());
    }
    syncs.extend((0..APPENDS).map(|_| file.append(&[0; 4_096])));
    syncs.sort_unstable();
    delays.sort_unstable();
    report.section(&format!("visible, {SE3}, writers: {writers}"), "");
    report.latency("until the copy of another process has it", &delays);
    report.latency("append of 4 KiB and fdatasync", &syncs);
    report.note("most pending writes of a writer", pending, "");
    if let (Some(first), Some(last)) = (at_first, at_last) {
        let micros = |seconds: f64| seconds * 1e6 / count as f64;
        let server = micros(last.server - first.server);
        report.note("the server's processor time an insert", server, "us");
        let writer = micros(last.writers - first.writers) / f64::from(writers);
        report.note("a writer's processor time an insert of any", writer, "us");
        let reader = micros(last.reader - first.reader);
        report.note("the reader's processor time an insert", reader, "us");
    }
}

/// The processor seconds that the processes have used.
struct Spent {
    server: f64,
    writers: f64,
    reader: f64,
}

impl Spent {
    fn now(server: &ServerProcess, writers: &[Process]) -> Option<Spent> {
        let writers = writers.iter().map(|writer| processor_seconds(writer.id()));
        Some(Spent {
            server: processor_seconds(server.process().id())?,
            writers: writers.sum::<Option<f64>>()?,
            reader: processor_seconds(std::process::id())?,
        })
    }
}

/// Looks for the points after `since` until there are `count`, whose tags tell their times. Returns their delays.
fn follow(index: &Index, mut since: ReadRevision, count: usize) -> Vec<Duration> {
    let mut delays = Vec::with_capacity(count);
    let mut progress = Instant::now();
    on_ticks(|| {
        let changes = index.changes(since).expect("an index");
        let changes = changes.expect("fewer changes than the copy remembers");
        let now = nanos();
        let stored = changes.stored.iter();
        let before = delays.len();
        delays.extend(stored.map(|point| Duration::from_nanos(now.saturating_sub(point.tag))));
        since = changes.read_revision;
        if delays.len() > before {
            progress = Instant::now();
        }
        assert!(
            progress.elapsed() < MAX_SILENCE,
            "{} of {count} points came; the copy has {:?} and is {:?}",
            delays.len(),
            index.len(),
            index.status(),
        );
        delays.len() < count
    });
    delays
}

/// Runs as a writer.
pub(crate) fn write() -> ExitCode {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let [uri, rate, seconds, seed] = &arguments[..] else {
        return ExitCode::FAILURE;
    };
    let number = |text: &str| text.parse::<u64>().expect("a number");
    let (rate, seconds, seed) = (number(rate), number(seconds), number(seed));
    let index = Index::shared(uri, "arm").open().expect("a shared index");
    let width = index.space().coordinates();
    let rows = States::new(index.space().clone(), seed).rows((rate * seconds) as usize);
    let mut rows = rows.chunks(width);
    println!("ready");
    let mut line = String::new();
    std::io::stdin().read_line(&mut line).expect("a line");
    let (start, mut inserted, mut pending) = (Instant::now(), 0, 0);
    on_ticks(|| {
        let due = (start.elapsed().as_secs_f64() * rate as f64) as u64;
        for row in rows.by_ref().take((due - inserted) as usize) {
            let options = InsertOptions::new().tag(nanos());
            index.insert_with(row, options).expect("an insert");
            inserted += 1;
        }
        pending = pending.max(index.pending());
        inserted < rate * seconds
    });
    index.flush().expect("a flush");
    println!("{pending}");
    ExitCode::SUCCESS
}

/// Acts on every tick, until the action returns false.
fn on_ticks(mut act: impl FnMut() -> bool) {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_time()
        .build()
        .expect("a runtime");
    runtime.block_on(async {
        let mut ticks = interval(TICK);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
        loop {
            ticks.tick().await;
            if !act() {
                return;
            }
        }
    });
}

/// The time of the clock that all processes share, in nanoseconds.
fn nanos() -> u64 {
    let now = SystemTime::UNIX_EPOCH
        .elapsed()
        .expect("a clock after 1970");
    u64::try_from(now.as_nanos()).unwrap_or(u64::MAX)
}
