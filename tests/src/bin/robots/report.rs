//! The figures: as a table for people, as JSON for programs.

use std::fmt;

use serde_json::{Value, json};
use wayfold_tests::figures::{median, quantile_ms};

use crate::{
    K, SPACE,
    searcher::{Form, Latencies, Throughput},
};

/// The measurements of the server, and of the bare queryable, round by round.
#[derive(Default)]
pub(crate) struct Rounds {
    pub(crate) one: (Vec<Latencies>, Vec<Latencies>),
    pub(crate) many: (Vec<Throughput>, Vec<Throughput>),
}

/// The medians of the server and of the bare queryable.
type Pair = (f64, f64);

impl Rounds {
    /// The time of a query with one in flight, in microseconds.
    fn quantile_us(&self, q: f64) -> Pair {
        let of = |ones: &[Latencies]| {
            let quantiles = ones.iter().map(|one| quantile_ms(&one.0, q) * 1e3);
            median(quantiles.collect())
        };
        (of(&self.one.0), of(&self.one.1))
    }

    fn many(&self, part: fn(&Throughput) -> f64) -> Pair {
        let of = |many: &[Throughput]| median(many.iter().map(part).collect());
        (of(&self.many.0), of(&self.many.1))
    }

    /// Answers per second with 64 queries in flight.
    fn rate(&self) -> Pair {
        self.many(|many| many.rate)
    }

    /// Processor time per answer, in microseconds.
    fn processor_us(&self) -> Pair {
        self.many(|many| many.processor_us)
    }
}

/// All measurements.
pub(crate) struct Report {
    pub(crate) points: usize,
    pub(crate) rounds: usize,
    pub(crate) forms: Vec<(Form, Rounds)>,
}

impl Report {
    pub(crate) fn to_json(&self) -> Value {
        let pair =
            |(server, bare): Pair| json!({"server": server, "bare": bare, "ratio": server / bare});
        let forms = self.forms.iter().map(|(form, measured)| {
            let found = json!({
                "one_in_flight_p50_us": pair(measured.quantile_us(0.5)),
                "one_in_flight_p99_us": pair(measured.quantile_us(0.99)),
                "many_in_flight_per_second": pair(measured.rate()),
                "processor_us": pair(measured.processor_us()),
            });
            (form.key().to_owned(), found)
        });
        json!({
            "points": self.points,
            "rounds": self.rounds,
            "forms": Value::Object(forms.collect()),
        })
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{SPACE}, {} points, k = {K}", self.points)?;
        let line = |f: &mut fmt::Formatter<'_>, what: &str, (server, bare): Pair| {
            let ratio = server / bare;
            writeln!(f, "{what:<38}{server:>10.1}{bare:>10.1}{ratio:>8.2}")
        };
        for (form, measured) in &self.forms {
            writeln!(f, "\n{form:?}")?;
            writeln!(f, "{:<38}{:>10}{:>10}{:>8}", "", "server", "bare", "ratio")?;
            line(f, "one in flight, p50 us", measured.quantile_us(0.5))?;
            line(f, "one in flight, p99 us", measured.quantile_us(0.99))?;
            line(f, "64 in flight, answers/s", measured.rate())?;
            line(f, "  processor an answer, us", measured.processor_us())?;
        }
        Ok(())
    }
}
