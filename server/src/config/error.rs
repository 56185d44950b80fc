//! Errors in the settings.

use std::{io, path::PathBuf};

use thiserror::Error;

/// The error of the settings. Every message names the key and its origin.
#[derive(Debug, Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the settings in {}: {source}", file.display())]
    Read {
        /// The file.
        file: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// The file is not valid TOML.
    #[error("{origin} is not valid TOML: {problem}")]
    Syntax {
        /// The file.
        origin: String,
        /// The problem and its place, without the line, which may hold a secret.
        problem: String,
    },
    /// The setting does not exist.
    #[error(
        "{origin}: there is no setting `{key}`; did you mean `{nearest}`? (wayfold-server --print-config lists all)"
    )]
    Unknown {
        /// The origin: a file, an environment variable or the command line.
        origin: String,
        /// The key that was set.
        key: String,
        /// The setting with the most similar name, spelled as the origin spells settings.
        nearest: String,
    },
    /// The value has the wrong type.
    #[error("{origin}: `{key}` takes {expected}, not {found}")]
    Type {
        /// The origin: a file, an environment variable or the command line.
        origin: String,
        /// The setting.
        key: String,
        /// The type of the setting.
        expected: &'static str,
        /// The value that was set, or the type of one that may hold a secret.
        found: String,
    },
    /// The value has the right type but is out of range.
    #[error("{origin}: `{key}`: {problem}")]
    Value {
        /// The origin: a file, an environment variable or the command line.
        origin: String,
        /// The setting.
        key: String,
        /// The problem.
        problem: String,
    },
}
