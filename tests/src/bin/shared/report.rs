//! The figures: as a table for people, as JSON for programs.

use std::{fs, time::Duration};

use serde_json::{Map, Value, json};
use wayfold_tests::figures::quantile_ms;

/// The report of a run.
pub(crate) struct Report {
    json: Map<String, Value>,
    section: String,
}

impl Report {
    pub(crate) fn new(rate: u32, seconds: u32) -> Report {
        let mut json = Map::new();
        json.insert("rate".into(), rate.into());
        json.insert("seconds".into(), seconds.into());
        json.insert("processor".into(), processor().into());
        println!("{rate} inserts a second for {seconds} s; {}", processor());
        Report {
            json,
            section: String::new(),
        }
    }

    /// Begins a part of the table.
    pub(crate) fn section(&mut self, title: &str) {
        println!(
            "\n{title:<44}{:>12}{:>12}{:>12}{:>12}",
            "p50 us", "p99 us", "p99.9 us", "max us"
        );
        self.section = title.to_owned();
        self.json.insert(title.to_owned(), json!({}));
    }

    /// Prints the quantiles of ascending durations.
    pub(crate) fn latency(&mut self, what: &str, taken: Vec<Duration>) {
        let [p50, p99, p999, max] =
            [0.5, 0.99, 0.999, 1.0].map(|q| quantile_ms(&taken, q) * 1_000.0);
        println!("  {what:<42}{p50:>12.2}{p99:>12.2}{p999:>12.2}{max:>12.2}");
        let figures = json!({"p50_us": p50, "p99_us": p99, "p99.9_us": p999, "max_us": max});
        self.put(what, figures);
    }

    /// Prints one figure.
    pub(crate) fn note(&mut self, what: &str, figure: f64, unit: &str) {
        println!("  {what:<42}{figure:>12.2} {unit}");
        self.put(what, json!({"figure": figure, "unit": unit}));
    }

    fn put(&mut self, what: &str, value: Value) {
        if let Some(Value::Object(section)) = self.json.get_mut(&self.section) {
            section.insert(what.to_owned(), value);
        }
    }

    pub(crate) fn into_json(self) -> Value {
        Value::Object(self.json)
    }
}

/// The processor and the number of its cores, as far as the system names them.
fn processor() -> String {
    let text = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let lines = text.lines().filter_map(|line| line.split_once(':'));
    let model = lines
        .filter(|(name, _)| name.trim() == "model name")
        .map(|(_, model)| model.trim())
        .next();
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    format!("{}, {cores} cores", model.unwrap_or("a processor"))
}
