//! Callers beside the load: the health check, and a bystander that asks for ten neighbours of one state.

use std::{net::SocketAddr, thread, time::Duration};

use bytes::Bytes;
use tokio::{
    runtime,
    sync::oneshot,
    time::{Instant, sleep_until, timeout},
};
use tonic::Code;
use tonic_health::pb::HealthCheckRequest;
use wayfold_tests::figures::quantile_ms;

use crate::{
    report::{Figures, Table},
    server::knn_frames,
    wire::{self, Client, HEALTH, KNN, LARGE_WINDOW, Outcome},
};

const HEALTH_PACE: Duration = Duration::from_millis(20);
const BYSTANDER_PACE: Duration = Duration::from_millis(10);
/// The time in which a connection must be made.
const CONNECT: Duration = Duration::from_secs(30);

/// One call. Its time counts from when it was due, unless the caller itself was late.
struct Sample {
    due: Instant,
    taken: Duration,
    /// None: it had no answer when the caller ended.
    outcome: Option<Outcome>,
}

/// A caller with one call at a time, at a fixed pace, on a connection and a thread of its own.
struct Probe {
    stop: oneshot::Sender<()>,
    thread: thread::JoinHandle<Vec<Sample>>,
}

impl Probe {
    fn start(address: SocketAddr, path: &'static str, message: Bytes, pace: Duration) -> Self {
        let (stop, stopped) = oneshot::channel();
        let thread = thread::spawn(move || {
            let runtime = runtime::Builder::new_current_thread().enable_all().build();
            let mut caller = Caller {
                address,
                path,
                message,
                next: Instant::now(),
                client: None,
                samples: Vec::new(),
            };
            runtime.expect("a runtime").block_on(async {
                tokio::select! {
                    () = caller.keep_calling(pace) => {}
                    _ = stopped => {}
                }
            });
            caller.finish(pace)
        });
        Self { stop, thread }
    }

    fn finish(self) -> Vec<Sample> {
        let _ = self.stop.send(());
        self.thread.join().expect("the caller's thread")
    }
}

struct Caller {
    address: SocketAddr,
    path: &'static str,
    message: Bytes,
    /// The time at which the next call, or the one under way, is due.
    next: Instant,
    client: Option<Client>,
    samples: Vec<Sample>,
}

impl Caller {
    async fn keep_calling(&mut self, pace: Duration) {
        loop {
            if Instant::now() < self.next {
                sleep_until(self.next).await;
                self.next = Instant::now();
            }
            let outcome = self.call().await;
            self.samples.push(Sample {
                due: self.next,
                taken: self.next.elapsed(),
                outcome: Some(outcome),
            });
            self.next += pace;
        }
    }

    async fn call(&mut self) -> Outcome {
        let client = match self.client.take() {
            Some(client) => client,
            None => match timeout(CONNECT, wire::connect(self.address, LARGE_WINDOW)).await {
                Ok(Ok(client)) => client,
                _ => return Outcome::Lost,
            },
        };
        let headers = wire::headers(self.address, self.path);
        let outcome = wire::call(&client, headers, self.message.clone()).await;
        self.client = (outcome != Outcome::Lost).then_some(client);
        outcome
    }

    /// The samples, with the calls that had no answer or were never made.
    fn finish(mut self, pace: Duration) -> Vec<Sample> {
        let now = Instant::now();
        while self.next < now {
            self.samples.push(Sample {
                due: self.next,
                taken: now - self.next,
                outcome: None,
            });
            self.next += pace;
        }
        self.samples
    }
}

/// The times of the calls due in a part of the measurement. A call without an answer counts with the time that it has waited.
fn figures(name: &str, samples: &[Sample], from: Instant, to: Instant) -> Figures {
    let part = samples.iter();
    let part = part.filter(|sample| from <= sample.due && sample.due < to);
    let (mut taken, mut failed, mut unanswered) = (Vec::new(), 0, 0);
    for sample in part {
        match sample.outcome {
            Some(Outcome::Status(Code::Ok)) => taken.push(sample.taken),
            Some(_) => failed += 1,
            None => {
                unanswered += 1;
                taken.push(sample.taken);
            }
        }
    }
    taken.sort();
    let mut figures = Figures::default();
    for (quantile, q) in [("p50", 0.5), ("p90", 0.9), ("p99", 0.99), ("max", 1.0)] {
        figures.add(&format!("{name} {quantile}, ms"), quantile_ms(&taken, q));
    }
    figures.add(&format!("{name} calls"), (taken.len() + failed) as f64);
    figures.add(&format!("{name} refused or lost"), failed as f64);
    figures.add(&format!("{name} unanswered"), f64::from(unanswered));
    figures
}

/// The health check alone.
pub(crate) struct Health {
    probe: Probe,
    began: Instant,
}

impl Health {
    pub(crate) fn start(address: SocketAddr) -> Self {
        let message = wire::frame(&HealthCheckRequest::default());
        Self {
            probe: Probe::start(address, HEALTH, message, HEALTH_PACE),
            began: Instant::now(),
        }
    }

    /// Ends it, and reports the calls that were due until then.
    pub(crate) fn finish(self, end: Instant) -> Figures {
        figures("health", &self.probe.finish(), self.began, end)
    }
}

/// The health check and a bystander, before, during and after a load.
pub(crate) struct Bystander {
    health: Health,
    bystander: Probe,
    parts: Vec<(&'static str, Instant)>,
}

impl Bystander {
    pub(crate) fn start(address: SocketAddr) -> Self {
        let request = knn_frames(1, 1, 10)[0].clone();
        Self {
            health: Health::start(address),
            bystander: Probe::start(address, KNN, request, BYSTANDER_PACE),
            parts: Vec::new(),
        }
    }

    /// Begins a part of the measurement, which lasts until the next begins.
    pub(crate) fn part(&mut self, name: &'static str) {
        self.parts.push((name, Instant::now()));
    }

    /// Ends both, with a column for each part.
    pub(crate) fn finish(self) -> Table {
        let mut ends: Vec<Instant> = self.parts.iter().skip(1).map(|part| part.1).collect();
        ends.push(Instant::now());
        let (health, bystander) = (self.health.probe.finish(), self.bystander.finish());
        let mut table = Table::default();
        for ((name, from), to) in self.parts.into_iter().zip(ends) {
            let mut column = figures("bystander", &bystander, from, to);
            column.extend(figures("health", &health, from, to));
            table.column(name, column);
        }
        table
    }
}
