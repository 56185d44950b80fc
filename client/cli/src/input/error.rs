//! Errors of input.

use std::io;

use thiserror::Error;
use wayfold::StateProblem;

/// The error of an input. A position is `FILE:LINE:COLUMN (NAME)` in CSV, with the columns counted from 1, and
/// `FILE[ROW, COLUMN] (NAME)` in npy, as numpy counts.
#[derive(Debug, Error)]
pub(crate) enum InputError {
    #[error("cannot read {file}: {source}")]
    Open { file: String, source: io::Error },
    #[error("{position}: {text:?} is not a finite number")]
    Number { position: String, text: String },
    #[error("{position}: {text:?} is not an id, a whole number from 0 to 9223372036854775807")]
    Id { position: String, text: String },
    #[error("{position}: id {id} is given twice, first in line {first}")]
    TwiceId {
        position: String,
        id: u64,
        first: u64,
    },
    #[error("{position}: {problem}")]
    State {
        position: String,
        problem: StateProblem,
    },
    #[error("{position}: {found} numbers, where a state of {space} has {}: {}", names.len(), names.join(", "))]
    Width {
        position: String,
        found: usize,
        space: String,
        names: Vec<String>,
    },
    #[error("{file}: no column {column:?} in the header; there are {}", columns.join(", "))]
    NoColumn {
        file: String,
        column: String,
        columns: Vec<String>,
    },
    #[error(
        "{position}: {text:?} is not a tag, a whole number below 2^64, decimal or hexadecimal after 0x"
    )]
    Tag { position: String, text: String },
    #[error("{file}: {option} names a column of a CSV header, and {problem}")]
    NoHeader {
        file: String,
        option: &'static str,
        problem: &'static str,
    },
    #[error("{position}: {problem}")]
    Format { position: String, problem: String },
    #[error(transparent)]
    Row(#[from] wayfold::Error),
}
