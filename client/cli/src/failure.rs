//! The failure of a command: the message, the exit status, and the error as a line of JSON.

mod json;
mod stopped;

use std::{io, path::PathBuf, time::Duration};

use thiserror::Error;
use wayfold::{Code, Error, SnapshotError};

use crate::{input::InputError, load::LoadError, status::Status};

pub(super) use json::{ErrorLine, usage_line};
pub(super) use stopped::stopped;

#[derive(Debug, Error)]
pub(super) enum Failure {
    #[error(transparent)]
    Client(#[from] Error),
    #[error(transparent)]
    Input(#[from] InputError),
    #[error(transparent)]
    Load(#[from] LoadError),
    #[error("cannot write to standard output: {0}")]
    Output(#[from] io::Error),
    #[error("cannot write to {}: {source}", path.display())]
    File { path: PathBuf, source: io::Error },
    #[error("{} exists; --force replaces it", path.display())]
    Exists { path: PathBuf },
    #[error("{} exists and is not a regular file", path.display())]
    NoFile { path: PathBuf },
    #[error("a snapshot cannot be written to a terminal: name a file, or send it through a pipe")]
    Terminal,
    #[error("interrupted; nothing was written")]
    Interrupted,
    #[error("{file}: {source}")]
    Snapshot { file: String, source: SnapshotError },
    #[error("{problems}")]
    Disagreement { problems: String },
    #[error(
        "{damaged} of {all} indices are damaged; the list shows the cause and the remedy of each; if nothing else helps, \
         `wayfold delete NAME` frees a name for `wayfold restore NAME FILE`"
    )]
    Damaged { damaged: usize, all: usize },
    #[error("{uri} does not serve: it is starting or stopping, or its store cannot be read")]
    NotServing { uri: String },
    #[error("{problem}")]
    Reset {
        reason: &'static str,
        problem: String,
    },
    #[error("{option}: {source}")]
    Credential { option: String, source: Error },
    #[error(
        "{source}: --ca is for the authority of the server, --cert and --key are for this client"
    )]
    Handshake { source: Error },
    #[error(
        "{given} is given alone; --cert and --key are given together: a certificate needs its private key"
    )]
    HalfCertificate { given: String },
    #[error("the system gives no random numbers: {0}")]
    Random(String),
    #[error("--server names no server")]
    NoServer,
    #[error("the process cannot start its threads: {0}")]
    Runtime(io::Error),
    /// `done` describes the progress of the command before the error `source`.
    #[error("{done}; then: {source}")]
    Stopped { done: String, source: Box<Failure> },
    #[error(
        "no server answers at {uri} ({problem}) within {timeout:?}: start one with `wayfold-server`, or give its \
         address with --server or WAYFOLD_SERVER"
    )]
    Unreachable {
        uri: String,
        problem: String,
        timeout: Duration,
    },
    #[error("{source}; --replace replaces the stored points")]
    Replaceable { source: Error },
    #[error("{source}; --timeout sets a longer wait than {timeout:?}")]
    Late { timeout: Duration, source: Error },
}

impl Failure {
    /// Adds the remedy to an error of the client.
    pub(super) fn explained(self, timeout: Duration) -> Failure {
        match self {
            // The attempt before the last one has the cause of the missing connection.
            Failure::Client(Error::Timeout {
                earlier: Some(earlier),
                ..
            }) if matches!(*earlier, Error::Connection { .. }) => {
                Failure::Client(*earlier).explained(timeout)
            }
            Failure::Client(Error::Connection { uri, source, .. }) => Failure::Unreachable {
                uri,
                problem: root_cause(source.as_ref()),
                timeout,
            },
            Failure::Client(source @ Error::Handshake { .. }) => Failure::Handshake { source },
            // A server that stops ends its calls at once.
            Failure::Client(source)
                if matches!(source.code(), Code::Unavailable | Code::DeadlineExceeded)
                    && source.reason() != Some("STOPPING") =>
            {
                Failure::Late { timeout, source }
            }
            Failure::Client(source) if source.reason() == Some("POINTS_EXIST") => {
                Failure::Replaceable { source }
            }
            Failure::Stopped { done, source } => Failure::Stopped {
                done,
                source: Box::new(source.explained(timeout)),
            },
            other => other,
        }
    }

    /// The exit status of a command that ends with this failure.
    pub(super) fn status(&self) -> Status {
        match self {
            Failure::Disagreement { .. } | Failure::Damaged { .. } | Failure::NotServing { .. } => {
                Status::Negative
            }
            Failure::Client(Error::Address { .. } | Error::Argument { field: "token", .. })
            | Failure::Credential { .. }
            | Failure::HalfCertificate { .. }
            | Failure::NoServer
            | Failure::Terminal => Status::Usage,
            Failure::Unreachable { .. } | Failure::Late { .. } => Status::NoAnswer,
            Failure::Client(error) if error.code() == Code::Unavailable => Status::NoAnswer,
            Failure::Stopped { source, .. } => source.status(),
            Failure::Load(error) => error.status(),
            Failure::Client(_)
            | Failure::Input(_)
            | Failure::Output(_)
            | Failure::File { .. }
            | Failure::Exists { .. }
            | Failure::NoFile { .. }
            | Failure::Interrupted
            | Failure::Snapshot { .. }
            | Failure::Reset { .. }
            | Failure::Random(_)
            | Failure::Handshake { .. }
            | Failure::Runtime(_)
            | Failure::Replaceable { .. } => Status::Failed,
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
    fn a_timeout_after_a_lost_connection_is_no_answer_and_names_the_server() {
        let lost = Error::Connection {
            call: "knn",
            uri: "http://there:1".into(),
            source: "Connection refused".into(),
        };
        let timeout = Duration::from_secs(5);
        let late = Error::Timeout {
            call: "knn",
            timeout,
            earlier: Some(Box::new(lost)),
        };
        let failure = Failure::from(late).explained(timeout);
        let message = failure.to_string();
        assert!(
            message.starts_with("no server answers at http://there:1 (Connection refused)"),
            "{message}"
        );
        assert_eq!(failure.status(), Status::NoAnswer);
    }
}
