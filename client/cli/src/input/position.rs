//! The position of a number in the input, for error messages.

use std::sync::Arc;

use wayfold::{Space, coordinate_names};

/// The position of a row.
#[derive(Clone, Debug)]
pub(super) struct InputPosition {
    pub(super) file: Arc<File>,
    pub(super) row: RowNumber,
}

/// The number of a row.
#[derive(Clone, Copy, Debug)]
pub(super) enum RowNumber {
    /// A line of CSV, from 1.
    Line(u64),
    /// A row of an npy file, from 0.
    Row(u64),
    /// The value of `--state`.
    Flag,
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
}

impl InputPosition {
    /// The position of a coordinate.
    pub(super) fn of(&self, coordinate: usize) -> String {
        let file = &self.file;
        let place = match self.row {
            RowNumber::Line(line) => format!(":{line}:{}", file.column(coordinate) + 1),
            RowNumber::Row(row) => format!("[{row}, {coordinate}]"),
            RowNumber::Flag => format!(": number {}", coordinate + 1),
        };
        let name = file.coordinates.get(coordinate);
        let name = name.map_or("too many", String::as_str);
        format!("{}{place} ({name})", file.name)
    }

    /// The position of a column of CSV, from 0.
    pub(super) fn of_column(&self, column: usize) -> String {
        format!("{}:{}", self.whole(), column + 1)
    }

    /// The position of the row.
    pub(super) fn whole(&self) -> String {
        match self.row {
            RowNumber::Line(line) => format!("{}:{line}", self.file.name),
            RowNumber::Row(row) => format!("{}[{row}]", self.file.name),
            RowNumber::Flag => self.file.name.clone(),
        }
    }

    /// The position of the row's id.
    pub(super) fn of_id(&self) -> String {
        self.of_column(self.file.id_column.unwrap_or(0))
    }

    /// The line of CSV; 0 elsewhere.
    pub(super) fn line(&self) -> u64 {
        match self.row {
            RowNumber::Line(line) => line,
            RowNumber::Row(_) | RowNumber::Flag => 0,
        }
    }
}
