//! Where a number stood, to name it in an error.

use std::sync::Arc;

/// Where a row stood.
#[derive(Clone, Debug)]
pub(super) enum Place {
    /// A line of CSV, from 1.
    Line { file: Arc<File>, line: u64 },
    /// A row of an npy file, from 0.
    Row { file: Arc<File>, row: u64 },
    /// The value of `--state`.
    Flag { file: Arc<File> },
}

/// What the rows of one input have in common.
#[derive(Debug)]
pub(super) struct File {
    pub(super) name: String,
    /// The names of the space's coordinates.
    pub(super) coordinates: Vec<String>,
    /// The column, from 0, that holds the ids.
    pub(super) id_column: Option<usize>,
}

impl File {
    /// The column, from 0, of a coordinate.
    pub(super) fn column(&self, coordinate: usize) -> usize {
        match self.id_column {
            Some(ids) if coordinate >= ids => coordinate + 1,
            _ => coordinate,
        }
    }

    fn coordinate(&self, coordinate: usize) -> &str {
        self.coordinates
            .get(coordinate)
            .map_or("too many", String::as_str)
    }
}

impl Place {
    /// The place of a coordinate.
    pub(super) fn of(&self, coordinate: usize) -> String {
        match self {
            Place::Line { file, line } => {
                let column = file.column(coordinate) + 1;
                format!(
                    "{}:{line}:{column} ({})",
                    file.name,
                    file.coordinate(coordinate)
                )
            }
            Place::Row { file, row } => {
                format!(
                    "{}[{row}, {coordinate}] ({})",
                    file.name,
                    file.coordinate(coordinate)
                )
            }
            Place::Flag { file } => {
                format!(
                    "{}: number {} ({})",
                    file.name,
                    coordinate + 1,
                    file.coordinate(coordinate)
                )
            }
        }
    }

    /// The place of the row's id.
    pub(super) fn of_id(&self) -> String {
        match self {
            Place::Line { file, line } => {
                let column = file.id_column.map_or(1, |column| column + 1);
                format!("{}:{line}:{column}", file.name)
            }
            Place::Row { .. } | Place::Flag { .. } => self.whole(),
        }
    }

    /// The place of the row.
    pub(super) fn whole(&self) -> String {
        match self {
            Place::Line { file, line } => format!("{}:{line}", file.name),
            Place::Row { file, row } => format!("{}[{row}]", file.name),
            Place::Flag { file } => file.name.clone(),
        }
    }

    /// The line of CSV; 0 elsewhere.
    pub(super) fn line(&self) -> u64 {
        match self {
            Place::Line { line, .. } => *line,
            Place::Row { .. } | Place::Flag { .. } => 0,
        }
    }
}
