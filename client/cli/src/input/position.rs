//! The position of a number in the input, for error messages.

use std::sync::Arc;

use wayfold::{Space, coordinate_names};

/// The position of a row.
#[derive(Clone, Debug)]
pub(super) enum InputPosition {
    /// A line of CSV, from 1.
    Line { file: Arc<File>, line: u64 },
    /// A row of an npy file, from 0.
    Row { file: Arc<File>, row: u64 },
    /// The value of `--state`.
    Flag { file: Arc<File> },
}

/// The file that the rows of a source share.
#[derive(Debug)]
pub(super) struct File {
    pub(super) name: String,
    /// The names of the space's coordinates.
    pub(super) coordinates: Vec<String>,
    /// The column of CSV, from 0, that holds the ids.
    pub(super) id_column: Option<usize>,
    /// The column of CSV, from 0, that holds the tags.
    pub(super) tag_column: Option<usize>,
}

impl File {
    /// The rows of a file without ids and tags.
    pub(super) fn of_states(name: &str, space: &Space) -> Arc<File> {
        Arc::new(File {
            name: name.to_owned(),
            coordinates: coordinate_names(space),
            id_column: None,
            tag_column: None,
        })
    }

    /// The number of columns that are not coordinates.
    pub(super) fn other_columns(&self) -> usize {
        usize::from(self.id_column.is_some()) + usize::from(self.tag_column.is_some())
    }

    /// The column, from 0, of a coordinate.
    pub(super) fn column(&self, coordinate: usize) -> usize {
        let others = [self.id_column, self.tag_column];
        let mut columns = (0..).filter(|column| !others.contains(&Some(*column)));
        columns.nth(coordinate).unwrap_or(coordinate)
    }

    fn coordinate(&self, coordinate: usize) -> &str {
        self.coordinates
            .get(coordinate)
            .map_or("too many", String::as_str)
    }
}

impl InputPosition {
    /// The position of a coordinate.
    pub(super) fn of(&self, coordinate: usize) -> String {
        match self {
            InputPosition::Line { file, line } => {
                let column = file.column(coordinate) + 1;
                format!(
                    "{}:{line}:{column} ({})",
                    file.name,
                    file.coordinate(coordinate)
                )
            }
            InputPosition::Row { file, row } => {
                format!(
                    "{}[{row}, {coordinate}] ({})",
                    file.name,
                    file.coordinate(coordinate)
                )
            }
            InputPosition::Flag { file } => {
                format!(
                    "{}: number {} ({})",
                    file.name,
                    coordinate + 1,
                    file.coordinate(coordinate)
                )
            }
        }
    }

    /// The position of a column of CSV, from 0; the row's where there are no columns.
    pub(super) fn of_column(&self, column: usize) -> String {
        match self {
            InputPosition::Line { file, line } => format!("{}:{line}:{}", file.name, column + 1),
            InputPosition::Row { .. } | InputPosition::Flag { .. } => self.whole(),
        }
    }

    /// The position of the row's id.
    pub(super) fn of_id(&self) -> String {
        match self {
            InputPosition::Line { file, .. } => self.of_column(file.id_column.unwrap_or(0)),
            InputPosition::Row { .. } | InputPosition::Flag { .. } => self.whole(),
        }
    }

    /// The position of the row.
    pub(super) fn whole(&self) -> String {
        match self {
            InputPosition::Line { file, line } => format!("{}:{line}", file.name),
            InputPosition::Row { file, row } => format!("{}[{row}]", file.name),
            InputPosition::Flag { file } => file.name.clone(),
        }
    }

    /// The line of CSV; 0 elsewhere.
    pub(super) fn line(&self) -> u64 {
        match self {
            InputPosition::Line { line, .. } => *line,
            InputPosition::Row { .. } | InputPosition::Flag { .. } => 0,
        }
    }
}
