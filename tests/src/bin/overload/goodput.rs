//! The answers in time of a server that gets two and four times as many calls as it can answer.

use std::{sync::Arc, time::Duration};

use bytes::Bytes;
use wayfold_tests::figures::processor_seconds;

use crate::{
    Arguments,
    generator::{Load, apart},
    probe::Health,
    progress,
    report::{Figures, Report, Table},
    server::{Server, knn_frames},
    tally::Tally,
};

const CONNECTIONS: usize = 50;
const DEADLINE: Duration = Duration::from_millis(500);

/// The calls of one size: the rows of each call, and the number of different calls. The peak is the best of the runs
/// with these numbers of calls in flight.
struct Size {
    rows: usize,
    requests: usize,
    in_flight: &'static [u64],
}

pub(crate) const ROWS: usize = 200;
const ONE: Size = Size {
    rows: 1,
    requests: 5_000,
    in_flight: &[100, 400, 1_600],
};
const MANY: Size = Size {
    rows: ROWS,
    requests: 64,
    in_flight: &[16, 50],
};

pub(crate) fn run(arguments: &Arguments, report: &mut Report) {
    for size in [ONE, MANY] {
        let server = Server::start(arguments);
        let load = load(&server, knn_frames(size.requests, size.rows, 10));
        let name = format!("goodput, Knn of {} rows", size.rows);
        progress(&format!("{name}: unloaded and peak"));
        let unloaded = Load {
            connections: 1,
            ..load.clone()
        };
        let short = arguments.length().min(Duration::from_secs(4));
        let (unloaded, cost) = costing(&server, || closed(unloaded, 1, short));
        let mut table = Table::default();
        let peaks = size.in_flight.iter().map(|&in_flight| {
            let health = Health::start(server.address);
            let (peak, cost) = costing(&server, || {
                closed(load.clone(), in_flight, arguments.length())
            });
            (in_flight, peak, cost, health.finish(server.settle()))
        });
        let peaks: Vec<_> = peaks.collect();
        let rate = best(peaks.iter().map(|(_, peak, ..)| peak.rate()));
        let mut column = unloaded.figures(Some(rate));
        column.extend(cost);
        table.column("one at a time", column);
        for (in_flight, peak, cost, health) in peaks {
            let mut column = peak.figures(Some(rate));
            column.extend(cost);
            column.extend(health);
            table.column(&format!("{in_flight} in flight"), column);
        }
        for times in [2, 4] {
            for deadline in [None, Some(DEADLINE)] {
                let callers = deadline.map_or("patient", |_| "500 ms");
                let phase = format!("{times}x {callers}");
                progress(&format!("{name}: {phase}"));
                let load = Load {
                    deadline,
                    ..load.clone()
                };
                let gap = 1.0 / (rate * f64::from(times));
                let health = Health::start(server.address);
                let tally = on_schedule(load, arguments.length(), move |n| {
                    Duration::from_secs_f64(n as f64 * gap)
                });
                let mut column = tally.figures(Some(rate));
                column.extend(health.finish(server.settle()));
                table.column(&phase, column);
            }
        }
        report.table(&name, &table);
    }
}

/// Calls over 50 connections whose callers are patient.
fn load(server: &Server, requests: Arc<Vec<Bytes>>) -> Load {
    Load {
        address: server.address,
        connections: CONNECTIONS,
        requests,
        deadline: None,
    }
}

/// Calls of 200 rows that a server can answer in a second.
pub(crate) fn peak(server: &Server, length: Duration) -> f64 {
    let load = load(server, knn_frames(MANY.requests, MANY.rows, 10));
    let peaks = MANY.in_flight.iter().map(|&in_flight| {
        let peak = closed(load.clone(), in_flight, length);
        server.settle();
        peak.rate()
    });
    best(peaks)
}

/// A phase, and the server's processor time for each of its answers.
fn costing(server: &Server, phase: impl FnOnce() -> Tally) -> (Tally, Figures) {
    let seconds = || processor_seconds(server.id()).unwrap_or(f64::NAN);
    let before = seconds();
    let tally = phase();
    let mut figures = Figures::default();
    let each = (seconds() - before) / tally.answered() as f64;
    figures.add("server's processor time an answer, us", each * 1e6);
    (tally, figures)
}

/// The highest rate.
fn best(rates: impl Iterator<Item = f64>) -> f64 {
    rates.fold(0.0, f64::max)
}

fn closed(load: Load, in_flight: u64, length: Duration) -> Tally {
    let phase = apart(load.closed(in_flight, length));
    phase.join().expect("the generator's thread")
}

pub(crate) fn on_schedule(
    load: Load,
    length: Duration,
    due: impl Fn(u64) -> Duration + Send + 'static,
) -> Tally {
    let phase = apart(load.on_schedule(length, due));
    phase.join().expect("the generator's thread")
}
