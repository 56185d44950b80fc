//! The figures: as tables for people, as JSON for programs.

use std::fmt::Write;

use serde_json::{Map, Value};

/// Named figures, a column of a table.
#[derive(Clone, Debug, Default)]
pub(crate) struct Figures(Vec<(String, f64)>);

impl Figures {
    pub(crate) fn add(&mut self, name: &str, figure: f64) {
        self.0.push((name.to_owned(), figure));
    }

    pub(crate) fn extend(&mut self, further: Figures) {
        self.0.extend(further.0);
    }

    fn get(&self, name: &str) -> Option<f64> {
        let found = self.0.iter().find(|(own, _)| own == name);
        found.map(|&(_, figure)| figure)
    }
}

/// Columns of figures; a figure that a column does not have is left out.
#[derive(Debug, Default)]
pub(crate) struct Table(Vec<(String, Figures)>);

impl Table {
    pub(crate) fn column(&mut self, name: &str, figures: Figures) {
        self.0.push((name.to_owned(), figures));
    }

    /// The names of the figures, each after those before it in its column.
    fn names(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        for (_, figures) in &self.0 {
            let mut at = 0;
            for (name, _) in &figures.0 {
                match names.iter().position(|known| known == name) {
                    Some(known) => at = known + 1,
                    None => {
                        names.insert(at, name);
                        at += 1;
                    }
                }
            }
        }
        names
    }

    fn text(&self) -> String {
        let mut text = format!("{:<38}", "");
        for (column, _) in &self.0 {
            let _ = write!(text, "{column:>16}");
        }
        text.push('\n');
        for name in self.names() {
            let _ = write!(text, "{name:<38}");
            for (_, figures) in &self.0 {
                let figure = figures.get(name);
                let figure = figure.map_or("-".into(), |figure| format!("{figure:.2}"));
                let _ = write!(text, "{figure:>16}");
            }
            text.push('\n');
        }
        text
    }

    fn json(&self) -> Value {
        let columns = self.0.iter().map(|(column, figures)| {
            let figures = figures.0.iter();
            let figures = figures.map(|(name, figure)| (name.clone(), Value::from(*figure)));
            (column.clone(), Value::Object(figures.collect()))
        });
        Value::Object(columns.collect())
    }
}

/// All figures.
#[derive(Debug, Default)]
pub(crate) struct Report(Map<String, Value>);

impl Report {
    /// Prints a table, and keeps it for the file.
    pub(crate) fn table(&mut self, title: &str, table: &Table) {
        println!("\n{title}\n{}", table.text());
        self.0.insert(title.to_owned(), table.json());
    }

    /// Keeps a fact about the run for the file.
    pub(crate) fn note(&mut self, name: &str, value: Value) {
        println!("{name}: {value}");
        self.0.insert(name.to_owned(), value);
    }

    pub(crate) fn into_json(self) -> Value {
        Value::Object(self.0)
    }
}
