//! The latency of an insert at a fixed rate.

use std::{
    hint,
    path::Path,
    time::{Duration, Instant},
};

use wayfold::Index;
use wayfold_index::Space;
use wayfold_tests::{States, figures::processor_seconds, measuring, report::Report};

use crate::Arguments;

/// Pending writes are counted once in this many inserts, because a count locks the writer.
const PENDING_EVERY: u32 = 1_000;

pub(crate) fn measure(arguments: &Arguments, directory: &Path, space: &str, report: &mut Report) {
    let server = measuring::server(&directory.join("data").to_string_lossy());
    let space: Space = space.parse().expect("a space");
    let index = Index::shared(server.uri(), "arm").create(&space).open();
    let index = index.expect("a shared index");
    let count = arguments.rate as usize * arguments.seconds as usize;
    let rows = States::new(space.clone(), 1).rows(count);
    let mut rows = rows.chunks(space.coordinates());

    let idle = at_rate(arguments, || {});
    let server_before = processor_seconds(server.process().id());
    let (mut pending, mut inserted) = (0, 0);
    let inserts = at_rate(arguments, || {
        let row = rows.next().expect("a row an insert");
        index.insert(row).expect("an insert");
        inserted += 1;
        if inserted % PENDING_EVERY == 0 {
            pending = pending.max(index.pending());
        }
    });
    let server_after = processor_seconds(server.process().id());
    let flush = Instant::now();
    index.flush().expect("a flush");
    let flush = flush.elapsed();

    report.section(&format!("insert, {space}"), "");
    report.latency("insert, from the time it was due", &inserts.from_due);
    report.latency("insert, the call alone", &inserts.alone);
    report.latency("nothing, from the time it was due", &idle.from_due);
    report.note("flush after them", flush.as_secs_f64() * 1e6, "us");
    report.note("most pending writes", pending as f64, "");
    if let (Some(before), Some(after)) = (server_before, server_after) {
        let micros = (after - before) * 1e6 / count as f64;
        report.note("the server's processor time an insert", micros, "us");
    }
}

/// The durations of actions, ascending.
struct Latencies {
    from_due: Vec<Duration>,
    alone: Vec<Duration>,
}

/// Acts at a fixed rate: an action that is late does not delay the time at which the next one is due.
fn at_rate(arguments: &Arguments, mut act: impl FnMut()) -> Latencies {
    let count = arguments.rate * arguments.seconds;
    let mut latencies = Latencies {
        from_due: Vec::with_capacity(count as usize),
        alone: Vec::with_capacity(count as usize),
    };
    let start = Instant::now();
    for number in 0..count {
        let due = start + Duration::from_secs_f64(f64::from(number) / f64::from(arguments.rate));
        let mut now = Instant::now();
        while now < due {
            hint::spin_loop();
            now = Instant::now();
        }
        act();
        let end = Instant::now();
        latencies.from_due.push(end - due);
        latencies.alone.push(end - now);
    }
    latencies.from_due.sort_unstable();
    latencies.alone.sort_unstable();
    latencies
}
