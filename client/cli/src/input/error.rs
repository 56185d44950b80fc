//! Errors of input.

use std::io;

use thiserror::Error;
use wayfold::StateProblem;

/// The error of an input. A place is `FILE:LINE:COLUMN (NAME)` in CSV, with the columns counted from 1, and
/// `FILE[ROW, COLUMN] (NAME)` in npy, as numpy counts.
#[derive(Debug, Error)]
pub(crate) enum InputError {
    #[error("cannot read {file}: {source}")]
    Open { file: String, source: io::Error },
    #[error("{place}: {text:?} is not a finite number")]
    Number { place: String, text: String },
    #[error("{place}: {text:?} is not an id, a whole number from 0 to 9223372036854775807")]
    Id { place: String, text: String },
    #[error("{place}: id {id} is given twice, first in line {first}")]
    TwiceId { place: String, id: u64, first: u64 },
    #[error("{place}: {problem}")]
    State {
        place: String,
        problem: StateProblem,
    },
    #[error("{place}: {found} numbers, where a state of {space} has {}: {}{hint}", names.len(), names.join(", "))]
    Width {
        place: String,
        found: usize,
        space: String,
        names: Vec<String>,
        hint: &'static str,
    },
    #[error("{file}: no column {column:?} in the header; there are {}", columns.join(", "))]
    NoColumn {
        file: String,
        column: String,
        columns: Vec<String>,
    },
    #[error(
        "{place}: {text:?} is not a tag, a whole number below 2^64, decimal or hexadecimal after 0x"
    )]
    Tag { place: String, text: String },
    #[error("{file}: {option} names a column of a CSV header, and {problem}")]
    NoHeader {
        file: String,
        option: &'static str,
        problem: &'static str,
    },
    #[error("{place}: {problem}")]
    Format { place: String, problem: String },
    #[error(transparent)]
    Row(#[from] wayfold::Error),
}
