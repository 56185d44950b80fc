//! Measures clients that each have one insert under way: into servers, over a few connections that they share, or as
//! records in JetStream alone: fenced, to one subject, one message under way at a time; records that wait for it leave
//! together in the next.
//!
//!     cargo run --release -p wayfold-tests --bin inserters -- (--servers URLS | --nats URLS) [--clients 64]
//!         [--seconds 5] [--patient] [--json FILE]

use std::{
    error::Error,
    path::PathBuf,
    process::ExitCode,
    time::{Duration, Instant},
};

use async_nats::{
    HeaderMap,
    header::NATS_EXPECTED_LAST_SUBJECT_SEQUENCE,
    jetstream::{
        self, Context, ErrorCode,
        context::{ContextBuilder, PublishError},
        message::PublishMessage,
        stream::Config,
    },
};
use clap::{Args, Parser};
use futures_util::future::join_all;
use serde_json::{Value, json};
use tokio::{
    sync::{mpsc, oneshot},
    time::interval,
};
use wayfold::{Client, RetryPolicy};
use wayfold_tests::{States, measuring};

const STREAM: &str = "bare";
const SUBJECT: &str = "bare.one";
/// About the bytes of an insert of one state of SE(3), as the journal stores it.
const RECORD_BYTES: usize = 200;
/// The servers of NATS that store each message.
const REPLICAS: usize = 3;

/// The longest outage that a patient client bears.
const MAX_OUTAGE: Duration = Duration::from_secs(60);

/// A message to NATS without an answer for this long counts as lost, as in the server.
const MESSAGE_TIMEOUT: Duration = Duration::from_secs(1);

/// The time between two attempts of such a client.
const RETRY_INTERVAL: Duration = Duration::from_millis(20);

/// Measures clients that each have one insert under way.
#[derive(Debug, Parser)]
#[command(name = "inserters")]
struct Arguments {
    #[command(flatten)]
    target: Target,
    /// The number of clients.
    #[arg(long, default_value_t = 64)]
    clients: usize,
    /// The connections that the clients share, spread over the servers.
    #[arg(long, default_value_t = 6)]
    connections: usize,
    /// The index.
    #[arg(long, default_value = "cost")]
    index: String,
    /// The time of the measurement.
    #[arg(long, default_value_t = 5)]
    seconds: u64,
    /// Repeats what has failed, so that the slowest insert tells how long none was taken.
    #[arg(long)]
    patient: bool,
    /// Writes the figures to a file, as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
}

/// The servers that get the inserts.
#[derive(Args, Debug)]
#[group(required = true, multiple = false)]
struct Target {
    /// The URLs of Wayfold's servers, separated by commas.
    #[arg(long, value_delimiter = ',')]
    servers: Vec<String>,
    /// The URLs of NATS's servers, separated by commas.
    #[arg(long, value_delimiter = ',')]
    nats: Vec<String>,
}

fn main() -> ExitCode {
    measuring::main(async |arguments: Arguments| {
        let figures = match &*arguments.target.servers {
            [] => publish(&arguments).await,
            servers => insert(servers, &arguments).await,
        };
        println!("{figures:#}");
        (figures, arguments.json)
    })
}

/// Each client inserts one state at a time.
async fn insert(servers: &[String], arguments: &Arguments) -> Value {
    let builder = Client::builder().timeout(MAX_OUTAGE);
    let builder = builder.retry(match arguments.patient {
        true => RetryPolicy::until_deadline(),
        false => RetryPolicy::never(),
    });
    let mut handles = Vec::new();
    for server in servers.iter().cycle().take(arguments.connections) {
        let client = builder.clone().connect(server).await.expect("a server");
        handles.push(client.index(&arguments.index).await.expect("the index"));
    }
    let clients = handles.iter().cycle().take(arguments.clients);
    let clients = clients.zip(0..).map(|(index, seed)| {
        let mut states = States::new(index.space().clone(), seed);
        move || {
            let (index, row) = (index.clone(), states.row());
            async move {
                index.insert([row]).await.expect("an insert");
            }
        }
    });
    run(clients, arguments.seconds).await
}

/// Each client publishes one record at a time.
async fn publish(arguments: &Arguments) -> Value {
    let client = async_nats::connect(&arguments.target.nats).await;
    let client = client.expect("NATS");
    let context = jetstream::new(client.clone());
    let config = Config {
        name: STREAM.into(),
        subjects: vec![SUBJECT.into()],
        num_replicas: REPLICAS,
        ..Config::default()
    };
    // An earlier measurement may have left one.
    let _ = context.delete_stream(STREAM).await;
    context.create_stream(config).await.expect("a stream");
    let context = ContextBuilder::new().timeout(MESSAGE_TIMEOUT);
    let context = context.ack_timeout(MESSAGE_TIMEOUT).build(client);
    let (records, waiting) = mpsc::channel::<oneshot::Sender<()>>(arguments.clients);
    let publishing = tokio::spawn(pack(context, arguments.clients, arguments.patient, waiting));
    let clients = (0..arguments.clients).map(|_| {
        let records = records.clone();
        move || {
            let records = records.clone();
            async move {
                let (record, acknowledged) = oneshot::channel();
                records.send(record).await.expect("a publisher");
                acknowledged.await.expect("an acknowledgement");
            }
        }
    });
    let figures = run(clients, arguments.seconds).await;
    drop(records);
    publishing.await.expect("a publisher");
    figures
}

/// The figures of clients that wait for the end of each insert before the next one.
async fn run<F>(clients: impl Iterator<Item = impl FnMut() -> F>, seconds: u64) -> Value
where
    F: Future<Output = ()>,
{
    let seconds = seconds.max(1);
    let until = Instant::now() + Duration::from_secs(seconds);
    let clients = clients.map(async |mut insert| {
        let mut latencies = Vec::new();
        while Instant::now() < until {
            let began = Instant::now();
            insert().await;
            latencies.push(began.elapsed().as_secs_f64() * 1e3);
        }
        latencies
    });
    let mut latencies = join_all(clients).await.concat();
    latencies.sort_by(f64::total_cmp);
    let at = |share: f64| latencies[((latencies.len() - 1) as f64 * share) as usize];
    json!({
        "rows_per_s": latencies.len() as f64 / seconds as f64,
        "p50_ms": at(0.5),
        "p99_ms": at(0.99),
        "max_ms": at(1.0),
    })
}

/// Publishes the records that wait as one message, behind the one before it.
async fn pack(
    context: Context,
    most: usize,
    is_patient: bool,
    mut waiting: mpsc::Receiver<oneshot::Sender<()>>,
) {
    let mut attempts = interval(RETRY_INTERVAL);
    let mut stream = context.get_stream(STREAM).await.expect("the stream");
    let mut newest = stream.info().await.expect("its state").state.last_sequence;
    let mut records = Vec::new();
    while waiting.recv_many(&mut records, most).await > 0 {
        let mut headers = HeaderMap::new();
        headers.insert(NATS_EXPECTED_LAST_SUBJECT_SEQUENCE, newest.to_string());
        let payload = vec![7; RECORD_BYTES * records.len()];
        let message = PublishMessage::build()
            .payload(payload.into())
            .headers(headers);
        newest = loop {
            let sent = context.send_publish(SUBJECT, message.clone()).await;
            match sent.expect("a connection").await {
                Ok(acknowledgement) => break acknowledgement.sequence,
                // NATS says so of a right number too while it stores another message.
                Err(error) if is_busy(&error) => {}
                Err(_) if is_patient => {
                    attempts.tick().await;
                    // The message may be there: only this program publishes.
                    match stream.info().await.map(|info| info.state.last_sequence) {
                        Ok(last) if last > newest => break last,
                        _ => {}
                    }
                }
                Err(error) => panic!("no acknowledgement: {error}"),
            }
        };
        for record in records.drain(..) {
            // The client waits for it.
            let _ = record.send(());
        }
    }
}

fn is_busy(error: &PublishError) -> bool {
    let source = error.source();
    let error = source.and_then(|source| source.downcast_ref::<jetstream::Error>());
    error.is_some_and(|error| error.error_code() == ErrorCode::STREAM_WRONG_LAST_SEQUENCE_CONSTANT)
}
