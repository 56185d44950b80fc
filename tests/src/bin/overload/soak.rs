//! Load at twice the peak for minutes, by processes that are killed in turn, beside two writers.
//!
//! The memory is to stay flat, and at the end the index is compared with what the writers wrote.

mod writers;

use std::{process::ExitCode, thread, time::Duration};

use tokio::{
    runtime,
    time::{Instant, sleep_until},
};
use wayfold_tests::{
    Process, Signal,
    figures::{median, resident_bytes},
    measuring,
};

use crate::{
    Arguments,
    generator::Load,
    goodput,
    probe::Health,
    progress,
    report::{Figures, Report, Table},
    server::{Server, knn_frames, pause},
};

/// The role of a process that makes load until it is killed. Its arguments are the server's address and the calls per
/// second. It prints the figures of each [`PHASE`].
pub(crate) const LOADER: &str = "loader";

const LOADERS: usize = 4;
const CONNECTIONS: usize = 12;
const REQUESTS: usize = 64;
/// The load over the peak.
const TIMES: f64 = 2.0;
/// One loader is killed, and another one started, so often.
const KILL_EVERY: u32 = 5;
const PHASE: Duration = Duration::from_secs(4);
/// The mutations and operations that an index keeps fill their windows within the first minute, and not after an hour.
const WINDOWS: [(&str, &str); 2] = [
    ("index.window_bytes", "4194304"),
    ("limits.max_operation_bytes", "1048576"),
];
const QUARTERS: [&str; 4] = [
    "first quarter",
    "second quarter",
    "third quarter",
    "last quarter",
];

pub(crate) fn run(arguments: &Arguments, report: &mut Report) {
    let server = Server::start_with(arguments, &WINDOWS);
    progress("soak: peak");
    let peak = goodput::peak(&server, Duration::from_secs(4));
    let start = || {
        let rate = TIMES * peak / LOADERS as f64;
        let mut command = measuring::command(LOADER);
        Process::spawn(command.args([server.address.to_string(), rate.to_string()]))
    };
    let writers = writers::start(&server);
    let mut loaders: Vec<Process> = (0..LOADERS).map(|_| start()).collect();
    let mut load = LoadPhases::default();
    let mut table = Table::default();
    let health = Health::start(server.address);
    let began = Instant::now();
    let mut second = 0;
    for (quarter, name) in (1..).zip(QUARTERS) {
        progress(&format!("soak: {name}"));
        let mut resident = Vec::new();
        let mut in_quarter = LoadPhases::default();
        while second < arguments.seconds * quarter / 4 {
            second += 1;
            let due = began + Duration::from_secs(u64::from(second));
            pause(due.saturating_duration_since(Instant::now()));
            resident.extend(resident_bytes(server.id()));
            if second % KILL_EVERY == 0 {
                // The oldest is the first.
                let killed = loaders.remove(0).stop(Signal::Kill);
                in_quarter.add(&killed.stdout);
                loaders.push(start());
            }
        }
        let mut figures = memory(&resident);
        if in_quarter.phases > 0.0 {
            let share = in_quarter.in_time() / peak;
            figures.add("answered in time, of the peak", share);
        }
        table.column(name, figures);
        load.join(&in_quarter);
    }
    let health = health.finish(Instant::now());
    for loader in loaders {
        load.add(&loader.stop(Signal::Kill).stdout);
    }
    assert!(load.phases > 0.0, "no loader has finished a phase");
    let written = writers.finish();
    server.settle();
    let after: Vec<u64> = resident_bytes(server.id()).into_iter().collect();
    table.column("after", memory(&after));
    report.table("soak, by quarter", &table);
    let (figures, wrong) = written.compare(&server, arguments.points);
    let mut all = load.figures(peak);
    all.extend(health);
    all.extend(figures);
    let mut table = Table::default();
    table.column("soak", all);
    report.table("soak, load and index", &table);
    assert_eq!(
        wrong, 0,
        "the index is not what the writers wrote: see the table"
    );
}

fn memory(resident: &[u64]) -> Figures {
    let mib = |bytes: u64| bytes as f64 / 1024.0 / 1024.0;
    let all: Vec<f64> = resident.iter().map(|&bytes| mib(bytes)).collect();
    let mut figures = Figures::default();
    if all.is_empty() {
        return figures;
    }
    figures.add("resident memory, median, MiB", median(all.clone()));
    figures.add(
        "resident memory, most, MiB",
        all.into_iter().fold(0.0, f64::max),
    );
    figures
}

/// Makes load until this process is killed.
pub(crate) fn load() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let address = arguments.next().and_then(|address| address.parse().ok());
    let rate = arguments.next().and_then(|rate| rate.parse::<f64>().ok());
    let gap = 1.0 / rate.expect("a rate");
    let load = Load {
        address: address.expect("an address"),
        connections: CONNECTIONS,
        requests: knn_frames(REQUESTS, goodput::ROWS, 10),
        deadline: None,
    };
    let due = move |n| Duration::from_secs_f64(n as f64 * gap);
    let runtime = runtime::Builder::new_current_thread().enable_time().build();
    let runtime = runtime.expect("a runtime");
    loop {
        let load = load.clone();
        // The next phase begins while the last calls of this one are answered, so that the load goes on.
        thread::spawn(move || {
            let tally = goodput::on_schedule(load, PHASE, due);
            let seconds = PHASE.as_secs_f64();
            let offered = tally.offered as f64 / seconds;
            let refused = tally.refusals() as f64 / seconds;
            println!("{offered} {} {refused}", tally.rate());
        });
        runtime.block_on(async { sleep_until(Instant::now() + PHASE).await });
    }
}

/// The phases that the loaders finished, with the sums of their rates.
#[derive(Default)]
struct LoadPhases {
    phases: f64,
    sums: [f64; 3],
}

impl LoadPhases {
    fn add(&mut self, lines: &[String]) {
        for line in lines {
            let rates: Vec<f64> = line.split(' ').flat_map(str::parse).collect();
            // A killed process leaves at most one line that is cut.
            if let Ok(rates) = <[f64; 3]>::try_from(rates) {
                self.phases += 1.0;
                for (sum, rate) in self.sums.iter_mut().zip(rates) {
                    *sum += rate;
                }
            }
        }
    }

    fn join(&mut self, other: &Self) {
        self.phases += other.phases;
        for (sum, other) in self.sums.iter_mut().zip(other.sums) {
            *sum += other;
        }
    }

    /// The calls a second offered, answered in time, and refused, by all loaders together.
    fn rates(&self) -> [f64; 3] {
        self.sums.map(|sum| sum / self.phases * LOADERS as f64)
    }

    fn in_time(&self) -> f64 {
        let [_, in_time, _] = self.rates();
        in_time
    }

    fn figures(&self, peak: f64) -> Figures {
        let [offered, in_time, refused] = self.rates();
        let mut figures = Figures::default();
        figures.add("phases", self.phases);
        figures.add("peak/s", peak);
        figures.add("offered/s", offered);
        figures.add("answered in time/s", in_time);
        figures.add("of the peak", in_time / peak);
        figures.add("refused/s", refused);
        figures
    }
}
