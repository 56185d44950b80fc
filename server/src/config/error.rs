//! What can be wrong with settings.

use std::{io, path::PathBuf};

use thiserror::Error;

/// Why the settings could not be taken. Every message names the key and where it was set.
#[derive(Debug, Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the settings in {}: {source}", file.display())]
    Read {
        /// The file.
        file: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The file is not TOML.
    #[error("{origin} is not valid TOML: {problem}")]
    Syntax {
        /// The file.
        origin: String,
        /// What is wrong, and where.
        problem: String,
    },
    /// There is no such setting.
    #[error(
        "{origin}: there is no setting `{key}`; did you mean `{nearest}`? (wayfold-server --print-config lists all)"
    )]
    Unknown {
        /// Where it was set.
        origin: String,
        /// What was set.
        key: String,
        /// The setting whose name is most like it, written as the origin writes it.
        nearest: String,
    },
    /// The value is of another type than the setting.
    #[error("{origin}: `{key}` takes {expected}, not {found}")]
    Type {
        /// Where it was set.
        origin: String,
        /// The setting.
        key: String,
        /// What it takes.
        expected: &'static str,
        /// What it was given.
        found: String,
    },
    /// The value is of the right type, and yet none that the setting can have.
    #[error("{origin}: `{key}`: {problem}")]
    Value {
        /// Where it was set.
        origin: String,
        /// The setting.
        key: String,
        /// Why not.
        problem: String,
    },
}
