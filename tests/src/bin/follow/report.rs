//! The figures: as a table for people, as JSON for programs.

use std::{fmt, time::Duration};

use serde_json::{Value, json};
use wayfold_tests::figures::{median, quantile_ms};

use crate::{
    K, SPACE,
    phase::{QueryRates, ReplicaFigures, Setting},
};

/// One of the rates of a measurement.
type Rate = fn(&QueryRates) -> f64;

/// All measurements, one value per round.
pub(crate) struct Report {
    /// The transport on which the replica receives mutations.
    feed: &'static str,
    points: usize,
    batch: usize,
    rates: Vec<f64>,
    replica: Vec<QueryRates>,
    forest: Vec<QueryRates>,
    lag: Quantiles,
    lag_from_sending: Quantiles,
    round_trip: Quantiles,
}

/// The p50 and p99 of each round, in milliseconds.
#[derive(Default)]
struct Quantiles {
    p50: Vec<f64>,
    p99: Vec<f64>,
}

impl Quantiles {
    fn add(&mut self, mut taken: Vec<Duration>) {
        taken.sort();
        self.p50.push(quantile_ms(&taken, 0.5));
        self.p99.push(quantile_ms(&taken, 0.99));
    }

    fn medians(&self) -> (f64, f64) {
        (median(self.p50.clone()), median(self.p99.clone()))
    }

    fn to_json(&self) -> Value {
        let (p50, p99) = self.medians();
        json!({"p50_ms": p50, "p99_ms": p99})
    }
}

impl Report {
    pub(crate) fn new(setting: &Setting) -> Report {
        Report {
            feed: match setting.session {
                Some(_) => "Zenoh",
                None => "gRPC",
            },
            points: setting.points,
            batch: setting.batch,
            rates: Vec::new(),
            replica: Vec::new(),
            forest: Vec::new(),
            lag: Quantiles::default(),
            lag_from_sending: Quantiles::default(),
            round_trip: Quantiles::default(),
        }
    }

    pub(crate) fn add_replica(&mut self, followed: ReplicaFigures) {
        self.rates.push(followed.fed.rate);
        self.replica.push(followed.asked);
        self.lag.add(followed.lags);
        self.lag_from_sending.add(followed.lags_from_sending);
        self.round_trip.add(followed.fed.round_trips);
    }

    pub(crate) fn add_forest(&mut self, asked: QueryRates) {
        self.forest.push(asked);
    }

    /// The medians of the replica and of the forest, and of the ratios of the rounds.
    fn rates(&self, of: impl Fn(&QueryRates) -> f64) -> (f64, f64, f64) {
        let pairs = self.replica.iter().zip(&self.forest);
        (
            median(self.replica.iter().map(&of).collect()),
            median(self.forest.iter().map(&of).collect()),
            median(pairs.map(|(one, other)| of(one) / of(other)).collect()),
        )
    }

    pub(crate) fn to_json(&self) -> Value {
        let rates = |of: Rate| {
            let (replica, forest, ratio) = self.rates(of);
            json!({"replica": replica, "forest": forest, "ratio": ratio})
        };
        json!({
            "feed": self.feed,
            "points": self.points,
            "rounds": self.rates.len(),
            "batch": self.batch,
            "inserts_per_second": median(self.rates.clone()),
            "queries_per_processor_second": rates(|asked| asked.by_processor),
            "queries_per_second": rates(|asked| asked.by_clock),
            "lag": self.lag.to_json(),
            "lag_from_sending": self.lag_from_sending.to_json(),
            "round_trip": self.round_trip.to_json(),
        })
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{SPACE}, {} points and {:.0} more a second in batches of {}, k = {K}; a replica fed over {}, all on one machine",
            self.points,
            median(self.rates.clone()),
            self.batch,
            self.feed,
        )?;
        writeln!(
            f,
            "{:<44}{:>10}{:>10}{:>8}",
            "", "replica", "forest", "ratio"
        )?;
        let rates: [(&str, Rate); 2] = [
            ("queries a second of processor time", |asked| {
                asked.by_processor
            }),
            ("queries a second", |asked| asked.by_clock),
        ];
        for (what, of) in rates {
            let (replica, forest, ratio) = self.rates(of);
            writeln!(f, "{what:<44}{replica:>10.0}{forest:>10.0}{ratio:>8.3}")?;
        }
        writeln!(
            f,
            "{:<44}{:>10}{:>10}{:>8}",
            "", "replica", "bare echo", "ratio"
        )?;
        let echo = self.round_trip.medians();
        for (what, lag) in [
            ("in the replica after the acknowledgement", &self.lag),
            ("in the replica after sending", &self.lag_from_sending),
        ] {
            let lag = lag.medians();
            for (name, lag, echo) in [("p50", lag.0, echo.0), ("p99", lag.1, echo.1)] {
                let what = format!("{what}, {name} ms");
                writeln!(f, "{what:<44}{lag:>10.3}{echo:>10.3}{:>8.2}", lag / echo)?;
            }
        }
        Ok(())
    }
}
