//! The outcomes of many calls.

use std::{collections::BTreeMap, time::Duration};

use h2::Reason;
use tokio::time::Instant;
use tonic::Code;
use wayfold_tests::figures::quantile_ms;

use crate::{report::Figures, wire::Outcome};

/// The time from the begin of a phase until the queue of the server stands, about.
const RAMP: Duration = Duration::from_secs(2);

/// The outcomes of the calls of one phase.
#[derive(Debug)]
pub(crate) struct Tally {
    /// The end of the phase: what is answered later does not count as answered in time.
    end: Instant,
    /// The length of the phase.
    length: Duration,
    /// The calls that were due.
    pub(crate) due: u64,
    /// The calls that the generator came to, whatever became of them.
    pub(crate) offered: u64,
    /// The calls that found the client's own queue full.
    pub(crate) not_sent: u64,
    in_time: u64,
    /// The times of the answers with status OK.
    accepted: Vec<Duration>,
    /// Those of the calls that were due after [`RAMP`].
    accepted_later: Vec<Duration>,
    refused: BTreeMap<i32, u64>,
    expired: u64,
    reset: BTreeMap<u32, u64>,
    lost: u64,
    /// The connections that ended, by the reason.
    connections_lost: BTreeMap<String, u64>,
    recorded: u64,
}

impl Tally {
    pub(crate) fn new(end: Instant, length: Duration) -> Self {
        Self {
            end,
            length,
            due: 0,
            offered: 0,
            not_sent: 0,
            in_time: 0,
            accepted: Vec::new(),
            accepted_later: Vec::new(),
            refused: BTreeMap::new(),
            expired: 0,
            reset: BTreeMap::new(),
            lost: 0,
            connections_lost: BTreeMap::new(),
            recorded: 0,
        }
    }

    /// Records the end of a call that was due at `due`.
    pub(crate) fn record(&mut self, due: Instant, outcome: Outcome) {
        self.recorded += 1;
        match outcome {
            Outcome::Status(Code::Ok) => {
                let now = Instant::now();
                self.in_time += u64::from(now <= self.end);
                self.accepted.push(now - due);
                if due + self.length >= self.end + RAMP {
                    self.accepted_later.push(now - due);
                }
            }
            Outcome::Status(code) => *self.refused.entry(code.into()).or_default() += 1,
            Outcome::Expired => self.expired += 1,
            Outcome::Reset(reason) => *self.reset.entry(reason).or_default() += 1,
            Outcome::Lost => self.lost += 1,
        }
    }

    /// Records the end of a connection.
    pub(crate) fn record_lost(&mut self, ended: Result<(), h2::Error>) {
        let reason = match ended {
            Err(error) if error.is_go_away() => {
                let by = if error.is_remote() {
                    "server"
                } else {
                    "client"
                };
                format!("{by}: {:?}", error.reason().unwrap_or(Reason::NO_ERROR))
            }
            _ => "otherwise".into(),
        };
        *self.connections_lost.entry(reason).or_default() += 1;
    }

    /// The calls that were taken on and have no outcome yet.
    pub(crate) fn open(&self) -> u64 {
        self.offered - self.not_sent - self.recorded
    }

    fn per_second(&self, count: u64) -> f64 {
        count as f64 / self.length.as_secs_f64()
    }

    /// The calls that were answered in time, per second.
    pub(crate) fn rate(&self) -> f64 {
        self.per_second(self.in_time)
    }

    /// The number of calls that were accepted.
    pub(crate) fn answered(&self) -> usize {
        self.accepted.len()
    }

    /// The number of calls that were refused by a status or a reset.
    pub(crate) fn refusals(&self) -> u64 {
        self.refused.values().chain(self.reset.values()).sum()
    }

    /// Sorts the times.
    pub(crate) fn finish(mut self) -> Self {
        self.accepted.sort();
        self.accepted_later.sort();
        self
    }

    /// Quantile of the accepted calls' times in milliseconds, once finished.
    pub(crate) fn quantile(&self, q: f64) -> f64 {
        quantile_ms(&self.accepted, q)
    }

    /// All figures; `peak` is a rate to compare with.
    pub(crate) fn figures(&self, peak: Option<f64>) -> Figures {
        let mut figures = Figures::default();
        figures.add("due/s", self.per_second(self.due));
        figures.add("offered/s", self.per_second(self.offered));
        figures.add("answered in time/s", self.rate());
        if let Some(peak) = peak {
            figures.add("of the peak", self.rate() / peak);
        }
        for (&code, &count) in &self.refused {
            let name = format!("refused/s, {:?}", Code::from_i32(code));
            figures.add(&name, self.per_second(count));
        }
        for (&reason, &count) in &self.reset {
            let name = format!("reset/s, {:?}", Reason::from(reason));
            figures.add(&name, self.per_second(count));
        }
        figures.add("expired/s", self.per_second(self.expired));
        figures.add("lost with a connection/s", self.per_second(self.lost));
        figures.add(
            "not sent: client's queue full/s",
            self.per_second(self.not_sent),
        );
        figures.add("open after 5 s more", self.open() as f64);
        for (reason, &count) in &self.connections_lost {
            figures.add(&format!("connections lost, {reason}"), count as f64);
        }
        figures.add("accepted p50, ms", self.quantile(0.5));
        figures.add("accepted p99, ms", self.quantile(0.99));
        let later = quantile_ms(&self.accepted_later, 0.99);
        figures.add("accepted p99 after 2 s, ms", later);
        if self.offered * 100 < self.due * 98 {
            figures.add(
                "GENERATOR TOO SLOW: of the rate",
                self.offered as f64 / self.due as f64,
            );
        }
        figures
    }
}
