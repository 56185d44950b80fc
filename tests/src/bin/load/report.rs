//! The figures: as a table for people, as JSON for programs.

use std::{fmt, time::Duration};

use serde_json::{Value, json};
use wayfold_tests::figures::{median, quantile_ms};

use crate::{K, SPACE, asking::Way, growth::Growth};

/// All that was measured; the server's first, the echo's second.
pub(crate) struct Report {
    pub(crate) growth: (Growth, Growth),
    pub(crate) asking: Vec<(Way, f64, f64)>,
    /// How many points the server held.
    pub(crate) points: u64,
    /// What it says that they take.
    pub(crate) memory_bytes: u64,
    /// What the system says that its process took, before and after.
    pub(crate) resident_bytes: Option<(u64, u64)>,
}

impl Report {
    /// Adds the medians of some measurements.
    pub(crate) fn add(&mut self, way: Way, (server, echo): (Vec<f64>, Vec<f64>)) {
        self.asking.push((way, median(server), median(echo)));
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
        let asking = self.asking.iter().map(|(way, server, echo)| {
            let rates = json!({"states_per_second": server, "echo": echo, "ratio": server / echo});
            (way.key().to_owned(), rates)
        });
        json!({
            "points": self.points,
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
        for (way, server, echo) in &self.asking {
            rate(f, &format!("{way}, states/s"), (*server, *echo))?;
        }
        let bytes = self.bytes_per_point();
        writeln!(f, "{:<36}{bytes:>10.0}", "bytes a point, by GetIndex")?;
        if let Some(bytes) = self.resident_bytes_per_point() {
            writeln!(f, "{:<36}{bytes:>10.0}", "bytes a point, resident in all")?;
        }
        Ok(())
    }
}

fn rate(f: &mut fmt::Formatter<'_>, what: &str, (server, echo): (f64, f64)) -> fmt::Result {
    writeln!(
        f,
        "{what:<36}{server:>10.0}{echo:>12.0}{:>8.2}",
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
