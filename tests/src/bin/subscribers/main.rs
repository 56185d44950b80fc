//! Measures the processor time that a server takes for an insert while 0, 1, 2, 4 and 8 subscribers watch the index.
//!
//!     cargo run --release -p wayfold-tests --bin subscribers -- [--rate 20000] [--seconds 5] [--rounds 3]
//!         [--min-batch 1] [--json FILE]
//!
//! A writer session puts SE(3) points (`R3*SO3:0.15`) at a fixed rate. A batch holds the puts that
//! arrived while the one before it was under way. The server has its default durability and runs in a separate process;
//! the writer and the subscribers are in this one.

use std::{
    path::PathBuf,
    process::ExitCode,
    time::{Duration, Instant},
};

use clap::Parser;
use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::{sync::mpsc, task::JoinSet};
use wayfold_proto::v1::{self, StepKind};
use wayfold_tests::{
    States, Stubs,
    figures::{median, processor_seconds},
    insert_request, measuring, row_states,
};

const SPACE: &str = "R3*SO3:0.15";
const WIDTH: usize = 7;
const SUBSCRIBERS: [usize; 5] = [0, 1, 2, 4, 8];
/// The number of states, drawn in advance and used repeatedly.
const POOL: usize = 4_096;

/// The server's own allocator, so that the measured program equals the shipped one.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Measures the processor time that a server takes for an insert while subscribers watch the index.
#[derive(Debug, Parser)]
#[command(name = "subscribers")]
struct Arguments {
    /// The number of points put per second.
    #[arg(long, default_value_t = 20_000)]
    rate: u64,
    /// A batch waits for this number of points: equal batches make measurements comparable.
    #[arg(long, default_value_t = 1)]
    min_batch: u64,
    /// The duration of each measurement in seconds.
    #[arg(long, default_value_t = 5)]
    seconds: u64,
    /// The number of rounds; the medians are reported.
    #[arg(long, default_value_t = 3)]
    rounds: u64,
    /// Writes the figures to a file, as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
}

/// One measurement.
struct Measured {
    /// Microseconds of the server's processor time for each point.
    micros: f64,
    /// Points in each batch.
    batch: f64,
    /// Messages to each subscriber for each batch.
    messages: f64,
}

fn main() -> ExitCode {
    measuring::main(async |arguments: Arguments| {
        let figures = measure_all(&arguments).await;
        (figures, arguments.json)
    })
}

async fn measure_all(arguments: &Arguments) -> Value {
    let mut measured: [Vec<Measured>; SUBSCRIBERS.len()] = Default::default();
    for _ in 0..arguments.rounds.max(1) {
        for (at, subscribers) in SUBSCRIBERS.into_iter().enumerate() {
            measured[at].push(measure(arguments, subscribers).await);
        }
    }
    println!("subscribers  µs an insert  points a batch  messages a batch");
    let rows = SUBSCRIBERS
        .iter()
        .zip(&measured)
        .map(|(subscribers, rounds)| {
            let of = |figure: fn(&Measured) -> f64| median(rounds.iter().map(figure).collect());
            let [micros, batch, messages] =
                [of(|it| it.micros), of(|it| it.batch), of(|it| it.messages)];
            println!("{subscribers:11}  {micros:12.2}  {batch:14.1}  {messages:16.2}");
            json!({"subscribers": subscribers, "us_an_insert": micros, "points_a_batch": batch,
            "messages_a_batch": messages})
        });
    json!({"rate": arguments.rate, "space": SPACE, "rows": rows.collect::<Vec<_>>()})
}

async fn measure(arguments: &Arguments, subscribers: usize) -> Measured {
    let data = TempDir::new().expect("a directory");
    let server = measuring::server(data.path().to_str().expect("a path in UTF-8"));
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("arm", SPACE).await;
    let writer = Writer::open(Stubs::connect(server.uri()).await, arguments).await;
    let (tell, mut began) = mpsc::channel(subscribers.max(1));
    let mut watches = JoinSet::new();
    for _ in 0..subscribers {
        let request = v1::WatchRequest {
            index_name: "arm".into(),
            ..Default::default()
        };
        watches.spawn(watch(server.uri().to_owned(), request, tell.clone()));
    }
    for _ in 0..subscribers {
        began.recv().await;
    }

    let process = server.process().id();
    let processor = || processor_seconds(process).expect("the server's processor time");
    let before = processor();
    let batches = tokio::spawn(writer.write()).await.expect("a writer");
    let last = insert_request("arm", &[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], WIDTH);
    stubs.insert(last).await;
    let messages: u64 = watches.join_all().await.iter().sum();
    let points = (arguments.seconds * arguments.rate) as f64;
    Measured {
        micros: (processor() - before) * 1e6 / points,
        batch: points / batches as f64,
        messages: messages as f64 / (batches as f64 * subscribers.max(1) as f64),
    }
}

/// One writer session.
struct Writer {
    stubs: Stubs,
    opened: v1::OpenSessionResponse,
    points: u64,
    rate: f64,
    min_batch: u64,
    pool: Vec<f64>,
}

impl Writer {
    async fn open(mut stubs: Stubs, arguments: &Arguments) -> Writer {
        let points = arguments.seconds * arguments.rate;
        let opening = v1::OpenSessionRequest {
            index_name: "arm".into(),
            reserve_count: points,
            ..Default::default()
        };
        let opened = stubs.points.open_session(opening).await;
        Writer {
            stubs,
            opened: opened.expect("a session").into_inner(),
            points,
            rate: arguments.rate as f64,
            min_batch: arguments.min_batch.max(1),
            pool: States::new(SPACE.parse().expect("a space"), 1).rows(POOL),
        }
    }

    /// Puts all points, each at its time, and returns the number of batches.
    async fn write(mut self) -> u64 {
        let revision = self.opened.revision.expect("a revision");
        let first_id = self.opened.reserved.expect("a block").first_id;
        let started = Instant::now();
        let mut times = tokio::time::interval(Duration::from_millis(1));
        let (mut put, mut batch) = (0, 0);
        while put < self.points {
            let due = (started.elapsed().as_secs_f64() * self.rate) as u64;
            let due = due.min(self.points);
            if due < self.points.min(put + self.min_batch) {
                times.tick().await;
                continue;
            }
            let rows = (put..due).flat_map(|at| &self.pool[at as usize % POOL * WIDTH..][..WIDTH]);
            let rows: Vec<f64> = rows.copied().collect();
            batch += 1;
            let request = v1::WriteRequest {
                index_name: "arm".into(),
                uid: revision.uid.clone(),
                session: self.opened.session,
                batch,
                kinds: vec![StepKind::Put.into(); (due - put) as usize],
                ids: (put..due).map(|at| first_id + at).collect(),
                states: Some(row_states(&rows, WIDTH)),
                ..Default::default()
            };
            let written = self.stubs.points.write(request).await;
            written.expect("a batch");
            put = due;
        }
        batch
    }
}

/// Counts the messages up to the one with the mutation that no session made.
async fn watch(uri: String, request: v1::WatchRequest, began: mpsc::Sender<()>) -> u64 {
    let mut stubs = Stubs::connect(&uri).await;
    let watch = stubs.points.watch(request).await.expect("a watch");
    let mut messages = watch.into_inner();
    let mut count = 0;
    while let Some(message) = messages.message().await.expect("a message") {
        if message.mutations.is_empty() {
            began.send(()).await.expect("a receiver");
            continue;
        }
        count += 1;
        if message.mutations.iter().any(|it| it.session == 0) {
            return count;
        }
    }
    panic!("the watch ended");
}
