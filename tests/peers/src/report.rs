//! The measurements, as a table for people and as JSON for programs.

use std::{fmt::Write, fs, path::Path};

use crate::{check::Case, data::Data, problem::Problem, structures::Kind};

/// The measured operation of a structure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Op {
    /// The nearest.
    Knn1,
    /// The ten nearest.
    Knn10,
    /// All within a radius that holds about ten.
    Radius,
    /// Single inserts of all points, one by one.
    Insert,
    /// A build from all points at once.
    Build,
    /// For each state in turn: a search of its nearest neighbour, then its insert.
    Rrt,
    /// The used memory, including the points.
    Memory,
}

impl Op {
    const ALL: [Op; 7] = [
        Op::Knn1,
        Op::Knn10,
        Op::Radius,
        Op::Insert,
        Op::Build,
        Op::Rrt,
        Op::Memory,
    ];

    /// The name in the tables.
    pub fn name(self) -> &'static str {
        match self {
            Op::Knn1 => "knn1",
            Op::Knn10 => "knn10",
            Op::Radius => "radius",
            Op::Insert => "insert",
            Op::Build => "build",
            Op::Rrt => "rrt",
            Op::Memory => "memory",
        }
    }

    fn unit(self) -> &'static str {
        match self {
            Op::Knn1 | Op::Knn10 | Op::Radius => "us",
            Op::Insert | Op::Build => "ns",
            Op::Rrt => "ms",
            Op::Memory => "bytes",
        }
    }
}

/// One figure.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Figure {
    /// The space, by name.
    pub space: String,
    /// The number of points.
    pub n: usize,
    /// The data, by name.
    pub data: String,
    /// The structure, by name.
    pub structure: String,
    /// The measured operation, by name.
    pub op: String,
    /// The median.
    pub value: f64,
    /// The unit of the value: for one query, one point, or the whole run.
    pub unit: String,
}

/// Reads what [`Report::write`] has written.
///
/// # Errors
/// The file cannot be read, or holds something else.
pub fn read(path: &Path) -> Result<Vec<Figure>, Problem> {
    let failed = |source| Problem::Read {
        path: path.to_owned(),
        source,
    };
    let text = fs::read_to_string(path).map_err(failed)?;
    serde_json::from_str(&text).map_err(|error| failed(error.into()))
}

/// All figures of a run.
#[derive(Debug, Default)]
pub struct Report {
    figures: Vec<Figure>,
    refused: Vec<(Kind, &'static str, Vec<String>)>,
}

impl Report {
    /// Adds a figure.
    pub fn add(&mut self, case: &Case<'_>, kind: Kind, op: Op, value: f64) {
        self.figures.push(Figure {
            space: case.name.to_owned(),
            n: case.points.len(),
            data: case.data.name().to_owned(),
            structure: kind.name().to_owned(),
            op: op.name().to_owned(),
            value,
            unit: op.unit().to_owned(),
        });
    }

    /// Notes that a structure is not measured in a space.
    pub fn refused(&mut self, kind: Kind, space: &str, reason: &'static str) {
        let known = self
            .refused
            .iter_mut()
            .find(|(other, why, _)| *other == kind && *why == reason);
        match known {
            Some((_, _, spaces)) if spaces.iter().any(|other| other == space) => {}
            Some((_, _, spaces)) => spaces.push(space.to_owned()),
            None => self.refused.push((kind, reason, vec![space.to_owned()])),
        }
    }

    /// Adds figures that were measured elsewhere.
    pub fn extend(&mut self, figures: impl IntoIterator<Item = Figure>) {
        self.figures.extend(figures);
    }

    /// The figure of a structure in a space, with `n` points of uniform data.
    pub fn uniform(&self, space: &str, n: usize, kind: Kind, op: Op) -> Option<f64> {
        self.find((space, n, Data::Uniform.name()), kind.name(), op)
    }

    /// The figure of a structure for a case: a space, a number of points and the name of the data.
    fn find(&self, case: (&str, usize, &str), structure: &str, op: Op) -> Option<f64> {
        let is_it = |row: &&Figure| {
            (row.space.as_str(), row.n, row.data.as_str()) == case
                && (row.structure.as_str(), row.op.as_str()) == (structure, op.name())
        };
        self.figures.iter().find(is_it).map(|row| row.value)
    }

    /// Writes the figures, one a line.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), Problem> {
        let mut text = String::from("[\n");
        for (at, figure) in self.figures.iter().enumerate() {
            let line = serde_json::to_string(figure).expect("numbers and strings");
            let end = if at + 1 < self.figures.len() {
                ",\n"
            } else {
                "\n"
            };
            text.push_str(&line);
            text.push_str(end);
        }
        text.push_str("]\n");
        fs::write(path, text).map_err(|source| Problem::Write {
            path: path.to_owned(),
            source,
        })
    }

    /// The table: a line for each space, data and operation, a column for each structure, and the ratios of the best
    /// peer's time to ours, growing and at rest.
    pub fn table(&self) -> String {
        let columns: Vec<Kind> = Kind::ALL
            .into_iter()
            .filter(|kind| self.figures.iter().any(|row| row.structure == kind.name()))
            .collect();
        let mut lines = vec![header(&columns)];
        let mut cases: Vec<(&str, usize, &str)> = Vec::new();
        for row in &self.figures {
            let case = (row.space.as_str(), row.n, row.data.as_str());
            if !cases.contains(&case) {
                cases.push(case);
            }
        }
        for case in cases {
            lines.push(Vec::new());
            for op in Op::ALL {
                lines.extend(self.line(case, op, &columns));
            }
        }
        let mut text = aligned(&lines);
        text.push('\n');
        for (kind, reason, spaces) in &self.refused {
            let _ = writeln!(
                text,
                "{}: not in {}: {reason}",
                kind.name(),
                spaces.join(", ")
            );
        }
        text + &self.uneven()
    }

    /// Our figures with non-uniform data, as multiples of those with uniform data.
    fn uneven(&self) -> String {
        let ops = [Op::Knn1, Op::Knn10, Op::Radius, Op::Insert, Op::Build];
        let mut header = ["data / uniform", "n", "data"].map(str::to_owned).to_vec();
        header.push("structure".to_owned());
        header.extend(ops.map(|op| op.name().to_owned()));
        let mut lines = vec![header];
        let mut seen = Vec::new();
        for row in self.figures.iter().filter(|row| row.data != "uniform") {
            let key = (&row.space, row.n, &row.data, &row.structure);
            let is_ours = |kind: &Kind| kind.is_ours() && kind.name() == row.structure;
            if seen.contains(&key) || !Kind::ALL.iter().any(is_ours) {
                continue;
            }
            seen.push(key);
            let value =
                |data: &str, op: Op| self.find((&row.space, row.n, data), &row.structure, op);
            let mut line = vec![row.space.clone(), row.n.to_string(), row.data.clone()];
            line.push(row.structure.clone());
            for op in ops {
                let ratio = value(&row.data, op).zip(value("uniform", op));
                line.push(
                    ratio.map_or_else(none, |(uneven, uniform)| format!("{:.2}", uneven / uniform)),
                );
            }
            lines.push(line);
        }
        if lines.len() == 1 {
            return String::new();
        }
        format!("\n{}", aligned(&lines))
    }

    fn line(&self, case: (&str, usize, &str), op: Op, columns: &[Kind]) -> Option<Vec<String>> {
        let value = |kind: &Kind| self.find(case, kind.name(), op);
        let values: Vec<Option<f64>> = columns.iter().map(value).collect();
        values.iter().flatten().next()?;
        let peers = columns
            .iter()
            .zip(&values)
            .filter(|(kind, _)| !kind.is_ours());
        let best = peers
            .filter_map(|(kind, value)| Some((*kind, (*value)?)))
            .min_by(|a, b| a.1.total_cmp(&b.1));
        let ratio = |ours: Kind| match (value(&ours), best) {
            (Some(own), Some((_, peer))) => format!("{:.2}", peer / own),
            _ => none(),
        };
        let (space, n, data) = case;
        let mut line = vec![
            space.to_owned(),
            n.to_string(),
            data.to_owned(),
            op.name().to_owned(),
            op.unit().to_owned(),
        ];
        line.extend(
            values
                .iter()
                .map(|value| value.map_or_else(none, three_digits)),
        );
        line.push(best.map_or_else(none, |(kind, _)| kind.name().to_owned()));
        line.push(ratio(Kind::Wayfold));
        line.push(ratio(Kind::WayfoldRest));
        Some(line)
    }
}

/// The cell of a table where no figure was measured.
pub fn none() -> String {
    String::from("–")
}

fn header(columns: &[Kind]) -> Vec<String> {
    let mut header: Vec<String> = ["space", "n", "data", "op", "unit"]
        .map(String::from)
        .into();
    header.extend(columns.iter().map(|kind| kind.name().to_owned()));
    header.extend(["best peer", "peer/ours", "peer/rest"].map(String::from));
    header
}

fn three_digits(value: f64) -> String {
    let digits = 2 - value.abs().log10().floor().clamp(-3.0, 2.0) as i32;
    format!("{value:.0$}", digits as usize)
}

/// Columns of equal width, the first five to the left.
pub fn aligned(lines: &[Vec<String>]) -> String {
    let columns = lines.iter().map(Vec::len).max().unwrap_or(0);
    let width = |at: usize| {
        let cells = lines.iter().filter_map(|line| line.get(at));
        cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let mut text = String::new();
    for line in lines {
        let mut cells = String::new();
        for (at, (cell, width)) in line.iter().zip(&widths).enumerate() {
            let _ = if at < 5 {
                write!(cells, "{cell:<width$}  ")
            } else {
                write!(cells, "{cell:>width$}  ")
            };
        }
        text.push_str(cells.trim_end());
        text.push('\n');
    }
    text
}
