//! Searches ten neighbours of one state, repeatedly.

use std::time::{Duration, Instant};

use prost::Message;
use serde_json::{Value, json};
use tokio::task::JoinSet;
use wayfold_index::Space;
use wayfold_proto::v1::KnnResponse;
use wayfold_tests::{States, figures::processor_seconds, knn_request};
use zenoh::{Session, bytes::Encoding};

use crate::{INDEX, K, WIDTH};

/// The duration of a measurement.
const DURATION: Duration = Duration::from_secs(2);
/// The maximum number of queries of each task.
const QUERIES: usize = 1_000_000;
/// The number of queries made in advance.
const POOL: usize = 5_000;
const IN_FLIGHT: usize = 64;

/// The form of a query.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Form {
    Protobuf,
    Json,
}

impl Form {
    /// Its section of the report.
    pub(crate) fn key(self) -> &'static str {
        match self {
            Form::Protobuf => "protobuf",
            Form::Json => "json",
        }
    }
}

/// The result of many queries in flight.
pub(crate) struct Throughput {
    /// Answers per second.
    pub(crate) rate: f64,
    /// Processor time of the process that answers, for each answer.
    pub(crate) processor_us: f64,
}

/// Queries in one form, with its own states.
#[derive(Clone)]
pub(crate) struct Searcher {
    form: Form,
    payloads: Vec<Vec<u8>>,
}

impl Searcher {
    pub(crate) fn new(space: &Space, form: Form, seed: u64) -> Self {
        let rows = States::new(space.clone(), 100 + seed).rows(POOL);
        let payloads = rows.chunks(WIDTH).map(|row| match form {
            Form::Protobuf => knn_request(INDEX, row, WIDTH, K).encode_to_vec(),
            Form::Json => json!({ "states": [row], "k": K }).to_string().into_bytes(),
        });
        Self {
            form,
            payloads: payloads.collect(),
        }
    }

    /// Queries with one in flight. Returns the durations of the answers, ascending.
    pub(crate) async fn one(&self, session: &Session) -> Vec<Duration> {
        let mut taken = self.ask(session, 0, Instant::now()).await;
        taken.sort();
        taken
    }

    /// Queries with 64 in flight; `process` answers.
    pub(crate) async fn many(&self, session: &Session, process: u32) -> Throughput {
        let before = processor_seconds(process);
        let started = Instant::now();
        let mut askers = JoinSet::new();
        for i in 0..IN_FLIGHT {
            let (asker, session) = (self.clone(), session.clone());
            let first = i * POOL / IN_FLIGHT;
            askers.spawn(async move { asker.ask(&session, first, started).await.len() });
        }
        let answered: usize = askers.join_all().await.into_iter().sum();
        let elapsed = started.elapsed().as_secs_f64();
        let taken = processor_seconds(process).zip(before);
        let taken = taken.map_or(f64::NAN, |(after, before)| after - before);
        Throughput {
            rate: answered as f64 / elapsed,
            processor_us: taken * 1e6 / answered as f64,
        }
    }

    async fn ask(&self, session: &Session, first: usize, started: Instant) -> Vec<Duration> {
        let key = format!("wayfold/v1/{INDEX}/knn");
        let mut taken = Vec::new();
        for at in first..first + QUERIES {
            let began = Instant::now();
            if began - started >= DURATION {
                break;
            }
            let query = session.get(&key).payload(self.payloads[at % POOL].clone());
            let replies = match self.form {
                Form::Protobuf => query.encoding(Encoding::APPLICATION_PROTOBUF),
                Form::Json => query.encoding(Encoding::APPLICATION_JSON),
            };
            let reply = replies.await.expect("a query").into_recv_async().await;
            let sample = reply.expect("a reply").into_result().expect("an answer");
            taken.push(began.elapsed());
            self.check(&sample.payload().to_bytes());
        }
        taken
    }

    /// Reads the answer as a planner does, outside the measured time.
    fn check(&self, payload: &[u8]) {
        match self.form {
            Form::Protobuf => {
                let answer = KnnResponse::decode(payload).expect("an answer");
                let neighbors = answer.neighbors.expect("neighbours");
                assert_eq!(neighbors.ids.len(), K as usize);
            }
            Form::Json => {
                let answer: Value = serde_json::from_slice(payload).expect("JSON");
                let ids = answer["ids"][0].as_array().expect("neighbours");
                assert_eq!(ids.len(), K as usize);
            }
        }
    }
}
