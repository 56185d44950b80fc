//! The figures: as a table for people, as JSON for programs.

use std::{fmt, time::Duration};

use serde_json::{Value, json};
use wayfold_tests::figures::{median, quantile_ms};

use crate::{
    K, SPACE,
    growth::Growth,
    searcher::{CallPattern, SearchRates},
    writers::{self, WRITERS, WriterRates},
};

/// The result of one round.
pub(crate) struct Round {
    pub(crate) server: SearchRates,
    pub(crate) echo: SearchRates,
    /// Processor time of the search alone.
    pub(crate) search_us: f64,
}

impl Round {
    /// The processor time of echo and search together, as a fraction of the time of the server and its client.
    fn share(&self) -> f64 {
        (self.echo.processor_us + self.search_us) / self.server.processor_us
    }
}

/// The medians of one way of asking.
pub(crate) struct Figures {
    way: CallPattern,
    server: SearchRates,
    echo: SearchRates,
    search_us: f64,
    /// The median of [`Round::share`].
    share: f64,
}

fn middle(asked: impl Iterator<Item = SearchRates> + Clone) -> SearchRates {
    let of = |part: fn(SearchRates) -> f64| median(asked.clone().map(part).collect());
    SearchRates {
        rate: of(|asked| asked.rate),
        processor_us: of(|asked| asked.processor_us),
        p50_ms: of(|asked| asked.p50_ms),
        p99_ms: of(|asked| asked.p99_ms),
    }
}

/// All measurements: the server's first, the echo's second.
pub(crate) struct Report {
    pub(crate) rounds: usize,
    pub(crate) growth: (Growth, Growth),
    pub(crate) asking: Vec<Figures>,
    /// The medians for each batch size.
    pub(crate) written: Vec<(usize, WriterRates)>,
    /// The number of points that the server held.
    pub(crate) points: u64,
    /// The memory that the server reports for its points.
    pub(crate) memory_bytes: u64,
    /// The resident memory of its process according to the system, before and after.
    pub(crate) resident_bytes: Option<(u64, u64)>,
}

impl Report {
    /// Adds the medians of some measurements.
    pub(crate) fn add(&mut self, way: CallPattern, rounds: &[Round]) {
        self.asking.push(Figures {
            way,
            server: middle(rounds.iter().map(|round| round.server)),
            echo: middle(rounds.iter().map(|round| round.echo)),
            search_us: median(rounds.iter().map(|round| round.search_us).collect()),
            share: median(rounds.iter().map(Round::share).collect()),
        });
    }

    /// Adds the medians of some measurements of one batch size.
    pub(crate) fn add_written(&mut self, batch: usize, rounds: &[WriterRates]) {
        let of = |part: fn(&WriterRates) -> f64| median(rounds.iter().map(part).collect());
        let written = WriterRates {
            rate: of(|written| written.rate),
            writer: of(|written| written.writer),
            processors: of(|written| written.processors),
        };
        self.written.push((batch, written));
    }

    fn bytes_per_point(&self) -> f64 {
        self.memory_bytes as f64 / self.points.max(1) as f64
    }

    fn resident_bytes_per_point(&self) -> Option<f64> {
        let (before, after) = self.resident_bytes?;
        Some(after.saturating_sub(before) as f64 / self.points.max(1) as f64)
    }

    pub(crate) fn to_json(&self) -> Value {
        let growth = |growth: &Growth| {
            json!({
                "inserts_per_second": growth.inserts_per_second,
                "insert_ms": quantiles(&growth.inserts),
                "query_ms": quantiles(&growth.queries),
                "queries": growth.queries.len(),
            })
        };
        let asked = |asked: &SearchRates| {
            json!({
                "states_per_second": asked.rate,
                "processor_us": asked.processor_us,
                "p50_ms": asked.p50_ms,
                "p99_ms": asked.p99_ms,
            })
        };
        let asking = self.asking.iter().map(|figures| {
            let found = json!({
                "server": asked(&figures.server),
                "echo": asked(&figures.echo),
                "search_us": figures.search_us,
                "ratio": figures.server.rate / figures.echo.rate,
                "echo_and_search": figures.share,
            });
            (figures.way.key().to_owned(), found)
        });
        let written = self.written.iter().map(|(batch, written)| {
            json!({
                "batch": batch,
                "states_per_second": written.rate,
                "writer_held": written.writer,
                "processors": written.processors,
            })
        });
        json!({
            "points": self.points,
            "rounds": self.rounds,
            "inserts_with_neighbors": written.collect::<Vec<_>>(),
            "growth": growth(&self.growth.0),
            "echo_growth": growth(&self.growth.1),
            "asking": Value::Object(asking.collect()),
            "bytes_per_point": self.bytes_per_point(),
            "resident_bytes_per_point": self.resident_bytes_per_point(),
        })
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let points = self.points;
        writeln!(
            f,
            "{SPACE}, {points} points, k = {K}; server, echo and client share one machine"
        )?;
        writeln!(
            f,
            "{:<34}{:>12}{:>12}{:>8}",
            "", "server", "bare echo", "ratio"
        )?;
        let (server, echo) = &self.growth;
        let rates = (server.inserts_per_second, echo.inserts_per_second);
        rate(f, "Insert, batches of 1,000, points/s", rates)?;
        for (what, server, echo) in [
            ("  an insert while it grew", &server.inserts, &echo.inserts),
            ("  a query while it grew", &server.queries, &echo.queries),
        ] {
            for (name, q) in [("median", 0.5), ("slowest", 1.0)] {
                let (server, echo) = (quantile_ms(server, q), quantile_ms(echo, q));
                let what = format!("{what}, {name} ms");
                writeln!(
                    f,
                    "{what:<36}{server:>10.2}{echo:>12.2}{:>8.2}",
                    server / echo
                )?;
            }
        }
        for figures in &self.asking {
            let Figures {
                way, server, echo, ..
            } = figures;
            rate(f, &format!("{way}, states/s"), (server.rate, echo.rate))?;
            if !server.p50_ms.is_nan() {
                let medians = (server.p50_ms * 1e3, echo.p50_ms * 1e3);
                rate(f, "  a call, p50 us", medians)?;
                rate(
                    f,
                    "  a call, p99 us",
                    (server.p99_ms * 1e3, echo.p99_ms * 1e3),
                )?;
            }
            let processors = (server.processor_us, echo.processor_us);
            rate(f, "  processor a state, both ends, us", processors)?;
            let (search, share) = (figures.search_us, figures.share);
            writeln!(f, "{:<36}{search:>10.1}", "  the search in process, us")?;
            writeln!(
                f,
                "{:<36}{:>22}{share:>8.2}",
                "  echo's processor and search / ours", ""
            )?;
        }
        let bytes = self.bytes_per_point();
        writeln!(f, "{:<36}{bytes:>10.0}", "bytes a point, by GetIndex")?;
        if let Some(bytes) = self.resident_bytes_per_point() {
            writeln!(f, "{:<36}{bytes:>10.0}", "bytes a point, resident in all")?;
        }
        if !self.written.is_empty() {
            let points = writers::POINTS;
            writeln!(
                f,
                "\n{WRITERS} writers without the network, into {points} points, {K} neighbours told of each state"
            )?;
            writeln!(
                f,
                "{:<34}{:>12}{:>12}{:>12}",
                "", "states/s", "writer held", "processors"
            )?;
        }
        for (batch, written) in &self.written {
            let what = format!("Insert, batches of {batch}");
            let (rate, held) = (written.rate, 100.0 * written.writer);
            let processors = written.processors;
            writeln!(f, "{what:<34}{rate:>12.0}{held:>10.0} %{processors:>12.2}")?;
        }
        Ok(())
    }
}

fn rate(f: &mut fmt::Formatter<'_>, what: &str, (server, echo): (f64, f64)) -> fmt::Result {
    let digits = if server < 1_000.0 { 1 } else { 0 };
    writeln!(
        f,
        "{what:<36}{server:>10.digits$}{echo:>12.digits$}{:>8.2}",
        server / echo
    )
}

fn quantiles(taken: &[Duration]) -> Value {
    json!({
        "p50": quantile_ms(taken, 0.5),
        "p99": quantile_ms(taken, 0.99),
        "p999": quantile_ms(taken, 0.999),
        "max": quantile_ms(taken, 1.0),
    })
}
