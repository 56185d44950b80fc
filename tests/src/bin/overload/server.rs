//! The server under load: a program of any version, pinned to a core.

use std::{
    net::SocketAddr,
    os::unix::process::CommandExt,
    path::PathBuf,
    process::{Command, ExitCode},
    sync::Arc,
    time::Duration,
};

use bytes::Bytes;
use tokio::{
    runtime::Handle,
    time::{Instant, sleep_until},
};
use wayfold::Client;
use wayfold_index::Space;
use wayfold_proto::v1::KnnRequest;
use wayfold_tests::{
    Process, ServerProcess, States,
    figures::{peak_resident_bytes, processor_seconds, reset_peak, resident_bytes},
    insert_request, knn_request, measuring,
};

use crate::{
    Arguments,
    report::{Figures, Table},
    wire,
};

/// The role of the process that pins itself to a core and becomes the server.
pub(crate) const PINNED: &str = "pinned";

const SPACE: &str = "R3*SO3:0.15";
pub(crate) const INDEX: &str = "arm";
pub(crate) const WIDTH: usize = 7;
/// The rows of an insert of the setup.
const ROWS: usize = 1_000;

/// The longest time for which the work of a phase may go on after it.
const SETTLE: Duration = Duration::from_secs(20);

/// Pins this process to the core that its first argument names, and runs the server that its other arguments name.
pub(crate) fn become_server() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let core = arguments.next().and_then(|core| core.parse().ok());
    crate::pin::to_core(core.expect("a core"));
    crate::pin::usual_file_limit();
    let program = arguments.next().expect("a program");
    let error = Command::new(&program)
        .env(measuring::ROLE, measuring::SERVER)
        .args(arguments)
        .exec();
    eprintln!("error: {program}: {error}");
    ExitCode::FAILURE
}

/// A server in memory with an index that holds points.
pub(crate) struct Server {
    process: ServerProcess,
    pub(crate) address: SocketAddr,
    /// Its Zenoh locator.
    pub(crate) zenoh: String,
}

impl Server {
    /// Starts it and fills the index.
    pub(crate) fn start(arguments: &Arguments) -> Self {
        Self::start_with(arguments, &[])
    }

    /// Starts it with these settings, below those of the arguments.
    pub(crate) fn start_with(arguments: &Arguments, settings: &[(&str, &str)]) -> Self {
        let mut command = measuring::command(PINNED);
        let own = command.get_program().to_owned();
        let server = arguments.server.as_ref();
        command
            .arg(arguments.server_core.to_string())
            .arg(server.map_or(own, |path| path.clone().into()))
            .args(["--grpc", "127.0.0.1:0", "--zenoh", "tcp/127.0.0.1:0"])
            .args(["--data", "memory"]);
        let given = arguments.set.iter().map(|(key, value)| (&**key, &**value));
        for (key, value) in settings.iter().copied().chain(given) {
            let key = key.to_uppercase().replace('.', "__");
            command.env(format!("WAYFOLD_{key}"), value);
        }
        let mut process = ServerProcess::ready(Process::spawn(&mut command));
        let zenoh = process.zenoh();
        let address = process.uri().trim_start_matches("http://");
        let address = address.parse().expect("an address");
        Handle::current().block_on(fill(process.uri(), arguments.points));
        let server = Self {
            process,
            address,
            zenoh,
        };
        server.settle();
        server
    }

    pub(crate) fn id(&self) -> u32 {
        self.process.process().id()
    }

    /// Waits until the work of a phase is done, and returns the time at which the wait began.
    pub(crate) fn settle(&self) -> Instant {
        let end = Instant::now();
        self.until_idle(SETTLE);
        end
    }

    /// Waits until it does little, and returns the processor time that it took meanwhile, in seconds.
    pub(crate) fn until_idle(&self, longest: Duration) -> f64 {
        Handle::current().block_on(until_idle(self.id(), longest))
    }

    /// Follows its memory from now on.
    pub(crate) fn memory(&self) -> Memory {
        reset_peak(self.id());
        Memory {
            process: self.id(),
            table: Table::default(),
        }
        .with("before", resident_bytes(self.id()))
    }
}

/// The memory of a server at some times.
pub(crate) struct Memory {
    process: u32,
    table: Table,
}

impl Memory {
    fn with(mut self, when: &str, bytes: Option<u64>) -> Self {
        let mut figures = Figures::default();
        let mib = bytes.map_or(f64::NAN, |bytes| bytes as f64 / 1024.0 / 1024.0);
        figures.add("resident memory, MiB", mib);
        self.table.column(when, figures);
        self
    }

    /// The table, once the load has ended: the peak, and the memory 2 s and 10 s after this call.
    pub(crate) fn after_the_load(self) -> Table {
        let process = self.process;
        let peak = self.with("peak", peak_resident_bytes(process));
        pause(Duration::from_secs(2));
        let soon = peak.with("2 s after", resident_bytes(process));
        pause(Duration::from_secs(8));
        let late = soon.with("10 s after", resident_bytes(process));
        late.table
    }
}

/// Waits without a load.
pub(crate) fn pause(length: Duration) {
    Handle::current().block_on(sleep_until(Instant::now() + length));
}

/// Waits until a process takes less than a tenth of a core over a second, and returns the processor time that it took
/// meanwhile, in seconds.
pub(crate) async fn until_idle(process: u32, longest: Duration) -> f64 {
    let end = Instant::now() + longest;
    let seconds = || processor_seconds(process).unwrap_or(f64::NAN);
    let first = seconds();
    let mut last = first;
    loop {
        sleep_until(Instant::now() + Duration::from_secs(1)).await;
        let now = seconds();
        let busy = now - last >= 0.1;
        if !busy || Instant::now() >= end {
            return now - first;
        }
        last = now;
    }
}

async fn fill(uri: &str, points: usize) {
    let client = Client::connect(uri).await.expect("a connection");
    let index = client.create_index(INDEX, &space()).await;
    let index = index.expect("an index");
    for rows in filler(points).chunks(ROWS * WIDTH) {
        let inserted = index.insert(rows.chunks(WIDTH)).await;
        inserted.expect("an insert");
    }
}

/// The states of the setup, in the order of their ids.
pub(crate) fn filler(points: usize) -> Vec<f64> {
    States::new(space(), 1).rows(points)
}

pub(crate) fn space() -> Space {
    SPACE.parse().expect("a space")
}

/// `count` different requests for the k nearest of `rows` states each.
pub(crate) fn knn(count: usize, rows: usize, k: u32) -> Vec<KnnRequest> {
    let drawn = States::new(space(), 2).rows(count * rows);
    let rows = drawn.chunks(rows * WIDTH);
    rows.map(|rows| knn_request(INDEX, rows, WIDTH, k))
        .collect()
}

/// Such requests as they are sent.
pub(crate) fn knn_frames(count: usize, rows: usize, k: u32) -> Arc<Vec<Bytes>> {
    Arc::new(knn(count, rows, k).iter().map(wire::frame).collect())
}

/// An insert of this number of rows as it is sent.
pub(crate) fn insert_frame(rows: usize) -> Bytes {
    let drawn = States::new(space(), 3).rows(rows);
    wire::frame(&insert_request(INDEX, &drawn, WIDTH))
}

/// Splits `KEY=VALUE`.
pub(crate) fn setting(text: &str) -> Result<(String, String), String> {
    let (key, value) = text.split_once('=').ok_or("it is not KEY=VALUE")?;
    Ok((key.to_owned(), value.to_owned()))
}

/// The path of a program, absolute: a started process finds it from anywhere.
pub(crate) fn program(text: &str) -> Result<PathBuf, String> {
    std::fs::canonicalize(text).map_err(|error| format!("{text}: {error}"))
}
