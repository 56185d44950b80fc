//! Why a command failed, in words for whoever typed it.

use std::{io, path::PathBuf, time::Duration};

use thiserror::Error;

use crate::input::InputError;
use wayfold::{Code, Error, SnapshotError};

#[derive(Debug, Error)]
pub(super) enum Failure {
    #[error(transparent)]
    Client(#[from] Error),
    #[error(transparent)]
    Input(#[from] InputError),
    #[error("cannot write to standard output: {0}")]
    Output(#[from] io::Error),
    #[error("cannot write to {}: {source}", path.display())]
    File { path: PathBuf, source: io::Error },
    #[error("{} exists; --force replaces it", path.display())]
    Exists { path: PathBuf },
    #[error("{} is there, and is no file", path.display())]
    NoFile { path: PathBuf },
    #[error("a snapshot is not for a terminal: name a file, or send it through a pipe")]
    Terminal,
    #[error("interrupted; nothing was written")]
    Interrupted,
    #[error("{file}: {source}")]
    Snapshot { file: String, source: SnapshotError },
    #[error("{what}")]
    Disagreement { what: String },
    #[error(
        "{damaged} of {all} indices cannot be read: the list says why, and what helps; `wayfold delete NAME` frees a \
         name for `wayfold restore NAME FILE`"
    )]
    Damaged { damaged: usize, all: usize },
    #[error("{what}")]
    Reset { what: String },
    #[error("--server names no server")]
    NoServer,
    #[error("the process cannot start its threads: {0}")]
    Runtime(io::Error),
    /// `done` says how far the command came before `source`.
    #[error("{done}; then: {source}")]
    Stopped { done: String, source: Box<Failure> },
    #[error(
        "no server answers at {uri} ({problem}), waited {waited:?}: start one with `wayfold-server`, or say where it \
         is with --server or WAYFOLD_SERVER"
    )]
    Unreachable {
        uri: String,
        problem: String,
        waited: Duration,
    },
    #[error("{source}; --replace does that here")]
    Replaceable { source: Error },
    #[error("{source}; waited {waited:?}, --timeout waits longer")]
    Late { waited: Duration, source: Error },
}

impl Failure {
    /// The failure to connect.
    pub(super) fn unreachable(error: Error, waited: Duration) -> Failure {
        Failure::from(error).explained(waited)
    }

    /// Says of a server that could not be reached what to do about it.
    pub(super) fn explained(self, waited: Duration) -> Failure {
        match self {
            // That the last try had no time left tells less.
            Failure::Client(Error::Timeout {
                earlier: Some(earlier),
                ..
            }) if matches!(*earlier, Error::Connection { .. }) => {
                Failure::Client(*earlier).explained(waited)
            }
            Failure::Client(Error::Connection { uri, source, .. }) => Failure::Unreachable {
                uri,
                problem: root_cause(source.as_ref()),
                waited,
            },
            Failure::Client(source)
                if matches!(source.code(), Code::Unavailable | Code::DeadlineExceeded) =>
            {
                Failure::Late { waited, source }
            }
            Failure::Client(source) if source.reason() == Some("POINTS_EXIST") => {
                Failure::Replaceable { source }
            }
            Failure::Stopped { done, source } => Failure::Stopped {
                done,
                source: Box::new(source.explained(waited)),
            },
            other => other,
        }
    }

    pub(super) fn is_broken_pipe(&self) -> bool {
        match self {
            Failure::Output(error) => error.kind() == io::ErrorKind::BrokenPipe,
            Failure::Stopped { source, .. } => source.is_broken_pipe(),
            _ => false,
        }
    }
}

/// The innermost error: "Connection refused" says more than the "transport error" around it.
fn root_cause(error: &(dyn std::error::Error + 'static)) -> String {
    let causes = std::iter::successors(Some(error), |error| error.source());
    causes.last().unwrap_or(error).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_server_that_went_away_is_told_of_though_the_last_try_had_no_time() {
        let gone = Error::Connection {
            call: "knn",
            uri: "http://there:1".into(),
            source: "Connection refused".into(),
        };
        let waited = Duration::from_secs(5);
        let late = Error::Timeout {
            call: "knn",
            timeout: waited,
            earlier: Some(Box::new(gone)),
        };
        let told = Failure::from(late).explained(waited).to_string();
        assert!(
            told.starts_with("no server answers at http://there:1 (Connection refused)"),
            "{told}"
        );
    }
}
