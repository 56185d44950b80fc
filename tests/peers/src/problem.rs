//! The errors of a run.

use std::path::PathBuf;

use wayfold_index::{SpaceError, StateError};

/// The error of a run that ends without its table.
#[derive(Debug, thiserror::Error)]
pub enum Problem {
    /// A text that describes no space.
    #[error("space {text:?}: {source}")]
    Space {
        /// The given text.
        text: String,
        /// The fault of the space.
        source: SpaceError,
    },
    /// Generated data that the space refuses: a bug of the generator.
    #[error("generated {data} data for {space}: {source}")]
    State {
        /// The name of the data.
        data: &'static str,
        /// The space, as text.
        space: String,
        /// The fault of the state.
        source: StateError,
    },
    /// A structure whose answer differs from brute force.
    #[error(
        "{structure} in {space} ({n} points, {data}), {op}, query {query}: {difference}; it is timed only when it equals \
         brute force"
    )]
    Mismatch {
        /// The structure.
        structure: &'static str,
        /// The space, by name.
        space: String,
        /// The number of points.
        n: usize,
        /// The name of the data.
        data: &'static str,
        /// The operation of the query.
        op: &'static str,
        /// The place of the query in the run.
        query: usize,
        /// The answer found against the correct one.
        difference: String,
    },
    /// The name of no structure or space.
    #[error("no {what} is called {name:?}; there are {known}")]
    Unknown {
        /// The kind of the named thing.
        what: &'static str,
        /// The given name.
        name: String,
        /// The valid names.
        known: String,
    },
    /// nigh, named in a build without it.
    #[error("this build has no nigh: set NIGH to a checkout of it and build again")]
    NoNigh,
    /// A program that cannot be run, or that failed.
    #[error("cannot measure with {program}: {source}", program = program.display())]
    Run {
        /// The program.
        program: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A file that cannot be read, or that holds no figures.
    #[error("cannot read figures from {path}: {source}", path = path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A file that cannot be written.
    #[error("cannot write {path}: {source}", path = path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
}
