//! The figures: a table printed line by line, and JSON at the end.

use serde_json::{Map, Value, json};

/// The target of a ratio.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Goal {
    /// A ratio of at least this.
    AtLeast(f64),
    /// A ratio of at most this.
    AtMost(f64),
}

/// The report of a run.
#[derive(Default)]
pub(crate) struct Report {
    json: Map<String, Value>,
    section: String,
}

impl Report {
    /// Begins a part of the table; its ratios refer to `against`.
    pub(crate) fn section(&mut self, title: &str, against: &str) {
        println!(
            "\n{title}\n{:<54}{:>18}{against:>18}{:>8}  goal",
            "", "measured", "ratio"
        );
        self.section = title.into();
        self.json.insert(title.into(), json!({}));
    }

    /// Prints a figure, the one it is compared with, and the target of their ratio.
    pub(crate) fn ratio(&mut self, what: &str, figure: f64, against: f64, unit: &str, goal: Goal) {
        let ratio = figure / against;
        let (sign, bound, reached) = match goal {
            Goal::AtLeast(bound) => (">=", bound, ratio >= bound),
            Goal::AtMost(bound) => ("<=", bound, ratio <= bound),
        };
        let reached = if reached { "" } else { "  MISSED" };
        println!(
            "  {what:<52}{:>18}{:>18} {ratio:>7.2}  {sign} {bound}{reached}",
            shown(figure, unit),
            shown(against, unit),
        );
        self.put(
            what,
            json!({"figure": figure, "against": against, "ratio": ratio, "unit": unit}),
        );
    }

    /// Prints a figure and the one it is compared with.
    pub(crate) fn compare(&mut self, what: &str, figure: f64, against: f64, unit: &str) {
        let ratio = figure / against;
        println!(
            "  {what:<52}{:>18}{:>18}{ratio:>8.2}",
            shown(figure, unit),
            shown(against, unit),
        );
        self.put(
            what,
            json!({"figure": figure, "against": against, "ratio": ratio, "unit": unit}),
        );
    }

    /// Prints a figure without a comparison.
    pub(crate) fn note(&mut self, what: &str, figure: f64, unit: &str) {
        println!("  {what:<52}{:>18}", shown(figure, unit));
        self.put(what, json!({"figure": figure, "unit": unit}));
    }

    /// Adds data for programs only; it is not printed.
    pub(crate) fn data(&mut self, what: &str, value: Value) {
        self.put(what, value);
    }

    fn put(&mut self, what: &str, value: Value) {
        if let Some(Value::Object(section)) = self.json.get_mut(&self.section) {
            section.insert(what.trim().into(), value);
        }
    }

    pub(crate) fn into_json(self) -> Value {
        Value::Object(self.json)
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
