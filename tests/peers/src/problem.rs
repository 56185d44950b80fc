//! What can go wrong in a run.

use std::path::PathBuf;

use wayfold_index::{SpaceError, StateError};

/// Why a run ends without its table.
#[derive(Debug, thiserror::Error)]
pub enum Problem {
    /// A text that is none of a space.
    #[error("space {text:?}: {source}")]
    Space {
        /// As it was given.
        text: String,
        /// What is wrong with it.
        source: SpaceError,
    },
    /// Generated data that the space refuses: a bug of the generator.
    #[error("generated {data} data for {space}: {source}")]
    State {
        /// The name of the data.
        data: &'static str,
        /// The space, as text.
        space: String,
        /// What is wrong with the state.
        source: StateError,
    },
    /// A structure that does not equal brute force.
    #[error(
        "{structure} in {space} ({n} points, {data}), {op}, query {query}: {difference}; it is timed only when it equals \
         brute force"
    )]
    Mismatch {
        /// The structure.
        structure: &'static str,
        /// The space, by name.
        space: String,
        /// How many points there were.
        n: usize,
        /// The name of the data.
        data: &'static str,
        /// What was asked.
        op: &'static str,
        /// The place of the query in the run.
        query: usize,
        /// What was found against what should have been.
        difference: String,
    },
    /// A name that no structure or space has.
    #[error("no {what} is called {name:?}; there are {known}")]
    Unknown {
        /// What was to be named.
        what: &'static str,
        /// As it was given.
        name: String,
        /// The names there are.
        known: String,
    },
    /// A program that cannot be run, or failed.
    #[error("cannot measure with {program}: {source}", program = program.display())]
    Run {
        /// The program.
        program: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// A file that cannot be read, or is none of figures.
    #[error("cannot read figures from {path}: {source}", path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// A file that cannot be written.
    #[error("cannot write {path}: {source}", path = path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
}
