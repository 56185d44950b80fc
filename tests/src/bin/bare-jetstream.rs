//! Measures JetStream alone, as the journal of a cluster uses it: fenced publishes to one subject, one under way at a time,
//! by one client, and by 64 whose records wait for each other and leave together.
//!
//!     cargo run --release -p wayfold-tests --bin bare-jetstream -- --nats URLS [--replicas 3] [--seconds 5] [--json FILE]

use std::{
    path::PathBuf,
    process::ExitCode,
    time::{Duration, Instant},
};

use async_nats::{
    HeaderMap,
    header::NATS_EXPECTED_LAST_SUBJECT_SEQUENCE,
    jetstream::{self, Context, message::PublishMessage, stream::Config},
};
use clap::Parser;
use serde_json::{Value, json};
use tokio::sync::{mpsc, oneshot};
use wayfold_tests::measuring;

const STREAM: &str = "bare";
const SUBJECT: &str = "bare.one";
/// About the bytes of an insert of one state of SE(3), as the journal stores it.
const RECORD_BYTES: usize = 200;
const CLIENTS: usize = 64;

/// Measures JetStream alone, as the journal of a cluster uses it.
#[derive(Debug, Parser)]
#[command(name = "bare-jetstream")]
struct Arguments {
    /// The URLs of the servers, separated by commas.
    #[arg(long)]
    nats: String,
    /// The number of servers that store each message.
    #[arg(long, default_value_t = 3)]
    replicas: usize,
    /// The time of each measurement.
    #[arg(long, default_value_t = 5)]
    seconds: u64,
    /// Writes the figures to a file, as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
}

fn main() -> ExitCode {
    measuring::main(async |arguments: Arguments| {
        let servers: Vec<_> = arguments.nats.split(',').collect();
        let client = async_nats::connect(servers).await.expect("NATS");
        let context = jetstream::new(client);
        let config = Config {
            name: STREAM.into(),
            subjects: vec![SUBJECT.into()],
            num_replicas: arguments.replicas,
            ..Config::default()
        };
        // An earlier measurement may have left one.
        let _ = context.delete_stream(STREAM).await;
        context.create_stream(config).await.expect("a stream");
        let time = Duration::from_secs(arguments.seconds.max(1));
        let mut figures = json!({});
        for clients in [1, CLIENTS] {
            figures[clients.to_string()] = publish(&context, clients, time).await;
        }
        println!("{figures:#}");
        (figures, arguments.json)
    })
}

/// Each of `clients` publishes one record at a time, and waits for its acknowledgement before the next.
async fn publish(context: &Context, clients: usize, time: Duration) -> Value {
    let (records, waiting) = mpsc::channel::<oneshot::Sender<()>>(clients);
    let publishing = tokio::spawn(pack(context.clone(), waiting));
    let until = Instant::now() + time;
    let clients: Vec<_> = (0..clients)
        .map(|_| {
            let records = records.clone();
            tokio::spawn(async move {
                let mut latencies = Vec::new();
                while Instant::now() < until {
                    let (record, acknowledged) = oneshot::channel();
                    let began = Instant::now();
                    records.send(record).await.expect("a publisher");
                    acknowledged.await.expect("an acknowledgement");
                    latencies.push(began.elapsed().as_secs_f64() * 1e3);
                }
                latencies
            })
        })
        .collect();
    drop(records);
    let mut latencies = Vec::new();
    for client in clients {
        latencies.extend(client.await.expect("a client"));
    }
    publishing.await.expect("a publisher");
    latencies.sort_by(f64::total_cmp);
    let at = |share: f64| latencies[((latencies.len() - 1) as f64 * share) as usize];
    json!({
        "rows_per_s": latencies.len() as f64 / time.as_secs_f64(),
        "p50_ms": at(0.5),
        "p99_ms": at(0.99),
    })
}

/// Publishes the records that wait as one message, behind the one before it.
async fn pack(context: Context, mut waiting: mpsc::Receiver<oneshot::Sender<()>>) {
    let mut stream = context.get_stream(STREAM).await.expect("the stream");
    let mut newest = stream.info().await.expect("its state").state.last_sequence;
    let mut records = Vec::new();
    while waiting.recv_many(&mut records, CLIENTS).await > 0 {
        let mut headers = HeaderMap::new();
        headers.insert(NATS_EXPECTED_LAST_SUBJECT_SEQUENCE, newest.to_string());
        let payload = vec![7; RECORD_BYTES * records.len()];
        let message = PublishMessage::build()
            .payload(payload.into())
            .headers(headers);
        let sent = context
            .send_publish(SUBJECT, message)
            .await
            .expect("a connection");
        newest = sent.await.expect("an acknowledgement").sequence;
        for record in records.drain(..) {
            // The client waits for it.
            let _ = record.send(());
        }
    }
}
