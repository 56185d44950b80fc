//! The errors of a load that no single call has.

use std::{io, path::PathBuf, time::Duration};

use thiserror::Error;

use crate::status::Status;

#[derive(Debug, Error)]
pub(crate) enum LoadError {
    #[error(
        "--face zenoh needs --locator, the address at which the server listens for Zenoh, as tcp/127.0.0.1:7448"
    )]
    NoLocator,
    #[error("--{option} is for --face zenoh; the faces grpc and shared take --server")]
    NotZenoh { option: &'static str },
    #[error("this program was built without Zenoh; build it with the feature zenoh")]
    #[cfg_attr(feature = "zenoh", expect(dead_code, reason = "of the other build"))]
    NoZenoh,
    #[error("no Zenoh session to {locator} within {timeout:?}: {problem}")]
    #[cfg_attr(
        not(feature = "zenoh"),
        expect(dead_code, reason = "of the other build")
    )]
    Session {
        locator: String,
        timeout: Duration,
        problem: String,
    },
    #[error("cannot read the scenario {}: {source}", path.display())]
    ScenarioFile { path: PathBuf, source: io::Error },
    #[error("{}: {problem}", path.display())]
    Scenario { path: PathBuf, problem: String },
    #[error("cannot write the report {}: {source}; nothing was sent", path.display())]
    Report { path: PathBuf, source: io::Error },
    #[error("cannot write the report {}: {source}", path.display())]
    ReportLost { path: PathBuf, source: io::Error },
    #[error(
        "index {index} holds no points, and get needs some: leave out --fill 0, or get from --mix"
    )]
    NothingToGet { index: String },
    #[error("no thread for a worker: {source}")]
    Thread { source: io::Error },
    #[error("a worker ended without a result")]
    Worker,
    #[error("a signal ended the run early; the figures are those of the calls until then")]
    Interrupted,
    #[error("none of {calls} calls was answered; the first failure: {first}")]
    NoAnswer { calls: u64, first: String },
    #[error(
        "points of this run may be left in {index}: {problem}; `wayfold scan {index} --tag {tag:#x}` lists them"
    )]
    Left {
        index: String,
        tag: u64,
        problem: String,
    },
}

impl LoadError {
    pub(crate) fn status(&self) -> Status {
        match self {
            LoadError::NoLocator | LoadError::NotZenoh { .. } | LoadError::NoZenoh => Status::Usage,
            LoadError::Session { .. } => Status::NoAnswer,
            LoadError::ScenarioFile { .. }
            | LoadError::Scenario { .. }
            | LoadError::Report { .. }
            | LoadError::ReportLost { .. }
            | LoadError::NothingToGet { .. }
            | LoadError::Thread { .. }
            | LoadError::Worker
            | LoadError::Interrupted
            | LoadError::NoAnswer { .. }
            | LoadError::Left { .. } => Status::Failed,
        }
    }

    /// The code and the reason in JSON.
    pub(crate) fn code_and_reason(&self) -> (&'static str, &'static str) {
        match self {
            LoadError::NoLocator | LoadError::NotZenoh { .. } => ("INVALID_ARGUMENT", "USAGE"),
            LoadError::NoZenoh => ("UNIMPLEMENTED", "NO_ZENOH"),
            LoadError::Session { .. } => ("UNAVAILABLE", "UNREACHABLE"),
            LoadError::ScenarioFile { .. } | LoadError::Scenario { .. } => {
                ("INVALID_ARGUMENT", "SCENARIO")
            }
            LoadError::Report { .. } | LoadError::ReportLost { .. } => ("UNKNOWN", "FILE"),
            LoadError::NothingToGet { .. } => ("FAILED_PRECONDITION", "NO_POINTS"),
            LoadError::Thread { .. } | LoadError::Worker => ("INTERNAL", "RUNTIME"),
            LoadError::Interrupted => ("CANCELLED", "INTERRUPTED"),
            LoadError::NoAnswer { .. } => ("UNKNOWN", "NO_CALL_ANSWERED"),
            LoadError::Left { .. } => ("UNKNOWN", "POINTS_LEFT"),
        }
    }
}
