//! Four ways to search ten neighbours, and the cost of an answer in each.

use std::{
    fmt, process,
    time::{Duration, Instant},
};

use tokio::{sync::mpsc, task::JoinSet};
use tokio_stream::wrappers::ReceiverStream;
use wayfold_proto::v1::{
    KnnRequest, StreamKnnRequest, knn_request::KForm, stream_knn_response::Result as StreamedAnswer,
};
use wayfold_tests::{
    ServerProcess, States, Stubs,
    figures::{processor_seconds, quantile_ms},
    row_states,
};

use crate::{INDEX, K, SPACE, WIDTH};

/// The duration of a measurement.
const DURATION: Duration = Duration::from_secs(2);
/// The maximum number of calls of a measurement.
const CALLS: usize = 1_000_000;
/// The number of query states, drawn in advance and used repeatedly.
const POOL: usize = 20_000;
const BATCH: usize = 1_000;
const IN_FLIGHT: usize = 64;
/// A measurement advances the progress bar by this much; an inserted point advances it by one.
pub(crate) const STEPS: usize = 20_000;

/// A way to ask.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum CallPattern {
    /// One client, one call of one state in flight.
    OneInFlight,
    /// One connection, 64 calls of one state in flight.
    ManyInFlight,
    /// One call of 1,000 states in flight.
    Batches,
    /// One stream, 64 requests of one state in flight.
    Streamed,
}

impl CallPattern {
    pub(crate) const ALL: [CallPattern; 4] = [
        CallPattern::OneInFlight,
        CallPattern::ManyInFlight,
        CallPattern::Batches,
        CallPattern::Streamed,
    ];

    /// Its name in JSON.
    pub(crate) fn key(self) -> &'static str {
        match self {
            CallPattern::OneInFlight => "one_in_flight",
            CallPattern::ManyInFlight => "many_in_flight",
            CallPattern::Batches => "batches",
            CallPattern::Streamed => "streamed",
        }
    }
}

impl fmt::Display for CallPattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            CallPattern::OneInFlight => "Knn, 1 in flight",
            CallPattern::ManyInFlight => "Knn, 64 in flight",
            CallPattern::Batches => "Knn, batches of 1,000",
            CallPattern::Streamed => "StreamKnn, 64 under way",
        })
    }
}

/// The result of one measurement.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SearchRates {
    /// States answered per second.
    pub(crate) rate: f64,
    /// Processor time for each, of server and client together, in microseconds.
    pub(crate) processor_us: f64,
    /// The duration of a call.
    pub(crate) p50_ms: f64,
    pub(crate) p99_ms: f64,
}

/// Searches in one way, with its own query states.
#[derive(Clone)]
pub(crate) struct Searcher {
    way: CallPattern,
    states: Vec<f64>,
    next: usize,
}

impl Searcher {
    pub(crate) fn new(way: CallPattern, seed: u64) -> Self {
        let space = SPACE.parse().expect("a space");
        let states = States::new(space, seed).rows(POOL);
        Self {
            way,
            states,
            next: 0,
        }
    }

    /// Queries a server in the given other process.
    pub(crate) async fn measure(&mut self, stubs: &Stubs, server: &ServerProcess) -> SearchRates {
        let processes = [server.process().id(), process::id()];
        let processor = || {
            let taken = processes.map(|process| processor_seconds(process).unwrap_or(f64::NAN));
            taken[0] + taken[1]
        };
        let (started, before) = (Instant::now(), processor());
        let (answered, mut taken) = self.ask_on(stubs, started).await;
        let (seconds, processor) = (started.elapsed().as_secs_f64(), processor() - before);
        taken.sort();
        SearchRates {
            rate: answered as f64 / seconds,
            processor_us: processor * 1e6 / answered as f64,
            p50_ms: quantile_ms(&taken, 0.5),
            p99_ms: quantile_ms(&taken, 0.99),
        }
    }

    /// The number of answered states, and the durations of the calls.
    async fn ask_on(&mut self, stubs: &Stubs, started: Instant) -> (usize, Vec<Duration>) {
        match self.way {
            CallPattern::OneInFlight => self.ask(stubs.clone(), 1, started).await,
            CallPattern::Batches => self.ask(stubs.clone(), BATCH, started).await,
            CallPattern::ManyInFlight => {
                let mut askers = JoinSet::new();
                for i in 0..IN_FLIGHT {
                    let (mut asker, stubs) = (self.clone(), stubs.clone());
                    asker.next = i * (POOL / IN_FLIGHT);
                    askers.spawn(async move { asker.ask(stubs, 1, started).await });
                }
                let asked = askers.join_all().await.into_iter();
                asked.fold((0, Vec::new()), |(sum, mut all), (answered, taken)| {
                    all.extend(taken);
                    (sum + answered, all)
                })
            }
            CallPattern::Streamed => (self.stream(stubs.clone(), started).await, Vec::new()),
        }
    }

    /// Searches with one call in flight.
    async fn ask(
        &mut self,
        mut stubs: Stubs,
        rows: usize,
        started: Instant,
    ) -> (usize, Vec<Duration>) {
        let (mut answered, mut taken) = (0, Vec::new());
        for _ in 0..CALLS {
            if started.elapsed() >= DURATION {
                break;
            }
            let request = self.request(rows);
            let called = Instant::now();
            let response = stubs.points.knn(request).await.expect("an answer");
            taken.push(called.elapsed());
            let neighbors = response.into_inner().neighbors.expect("neighbours");
            assert_eq!(neighbors.ids.len(), rows * K as usize);
            answered += rows;
        }
        (answered, taken)
    }

    async fn stream(&mut self, mut stubs: Stubs, started: Instant) -> usize {
        let (sender, requests) = mpsc::channel(IN_FLIGHT);
        let requests = ReceiverStream::new(requests);
        let answers = stubs.points.stream_knn(requests).await;
        let mut answers = answers.expect("a stream").into_inner();
        for _ in 0..IN_FLIGHT {
            let request = self.streamed_request();
            sender.send(request).await.expect("an open stream");
        }
        let mut sender = Some(sender);
        let mut answered = 0;
        while let Some(answer) = answers.message().await.expect("an answer") {
            let Some(StreamedAnswer::Knn(answer)) = answer.result else {
                panic!("a refusal: {answer:?}");
            };
            let neighbors = answer.neighbors.expect("neighbours");
            assert_eq!(neighbors.ids.len(), K as usize);
            answered += 1;
            if started.elapsed() >= DURATION || answered >= CALLS {
                sender = None;
            }
            if let Some(sender) = &sender {
                let request = self.streamed_request();
                sender.send(request).await.expect("an open stream");
            }
        }
        answered
    }

    fn streamed_request(&mut self) -> StreamKnnRequest {
        StreamKnnRequest {
            knn: Some(self.request(1)),
        }
    }

    /// A request about the next states of the pool.
    pub(crate) fn request(&mut self, rows: usize) -> KnnRequest {
        if (self.next + rows) > POOL {
            self.next = 0;
        }
        let coordinates = &self.states[self.next * WIDTH..][..rows * WIDTH];
        self.next += rows;
        KnnRequest {
            index_name: INDEX.into(),
            states: Some(row_states(coordinates, WIDTH)),
            k_form: Some(KForm::K(K)),
            ..Default::default()
        }
    }
}
