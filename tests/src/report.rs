//! The figures of a program: a table printed line by line, and JSON at the end.

use std::time::Duration;

use serde_json::{Value, json};

use crate::figures::quantile_ms;

/// The target of a ratio.
#[derive(Clone, Copy, Debug)]
pub enum Goal {
    /// A ratio of at least this.
    AtLeast(f64),
    /// A ratio of at most this.
    AtMost(f64),
}

/// The report of a run.
#[derive(Debug, Default)]
pub struct Report {
    json: Value,
    section: String,
}

impl Report {
    /// Begins a part of the table; its ratios refer to `against`, which is empty if it has none.
    pub fn section(&mut self, title: &str, against: &str) {
        println!("\n{title}");
        if !against.is_empty() {
            println!("{:>72}{against:>18}   ratio  goal", "measured");
        }
        self.section = title.into();
        self.json[title] = json!({});
    }

    /// Prints a figure, the one it is compared with, and the target of their ratio.
    pub fn ratio(&mut self, what: &str, figure: f64, against: f64, unit: &str, goal: Goal) {
        let ratio = figure / against;
        let (sign, bound, reached) = match goal {
            Goal::AtLeast(bound) => (">=", bound, ratio >= bound),
            Goal::AtMost(bound) => ("<=", bound, ratio <= bound),
        };
        let reached = if reached { "" } else { "  MISSED" };
        let goal = format!("  {sign} {bound}{reached}");
        self.pair(what, figure, against, unit, &goal);
    }

    /// Prints a figure and the one it is compared with.
    pub fn compare(&mut self, what: &str, figure: f64, against: f64, unit: &str) {
        self.pair(what, figure, against, unit, "");
    }

    fn pair(&mut self, what: &str, figure: f64, against: f64, unit: &str, goal: &str) {
        let ratio = figure / against;
        println!(
            "  {what:<52}{:>18}{:>18}{ratio:>8.2}{goal}",
            shown(figure, unit),
            shown(against, unit),
        );
        let pair = json!({"figure": figure, "against": against, "ratio": ratio, "unit": unit});
        self.data(what, pair);
    }

    /// Prints the quantiles of ascending durations.
    pub fn latency(&mut self, what: &str, taken: &[Duration]) {
        let [p50, p99, p999, max] =
            [0.5, 0.99, 0.999, 1.0].map(|q| quantile_ms(taken, q) * 1_000.0);
        println!("  {what:<44} p50 {p50:.2}, p99 {p99:.2}, p99.9 {p999:.2}, max {max:.2} us");
        let figures = json!({"p50_us": p50, "p99_us": p99, "p99.9_us": p999, "max_us": max});
        self.data(what, figures);
    }

    /// Prints a figure without a comparison.
    pub fn note(&mut self, what: &str, figure: f64, unit: &str) {
        println!("  {what:<52}{:>18}", shown(figure, unit));
        self.data(what, json!({"figure": figure, "unit": unit}));
    }

    /// Adds data for programs only, to the section or, before the first one, to the whole; it is not printed.
    pub fn data(&mut self, what: &str, value: Value) {
        let part = match self.section.as_str() {
            "" => &mut self.json,
            section => &mut self.json[section],
        };
        part[what.trim()] = value;
    }

    /// The figures of all sections.
    pub fn into_json(self) -> Value {
        self.json
    }
}

fn shown(figure: f64, unit: &str) -> String {
    let decimals = if figure.abs() >= 1000.0 || figure.fract() == 0.0 {
        0
    } else {
        3
    };
    format!("{figure:.decimals$} {unit}").trim_end().into()
}
