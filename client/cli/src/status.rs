//! The exit status of the command.

use std::process::ExitCode;

/// The exit status. The numbers are fixed, because scripts match on them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Status {
    Success = 0,
    Negative = 1,
    Usage = 2,
    Failed = 3,
    NoAnswer = 4,
}

impl Status {
    const ALL: [Status; 5] = [
        Status::Success,
        Status::Negative,
        Status::Usage,
        Status::Failed,
        Status::NoAnswer,
    ];

    fn meaning(self) -> &'static str {
        match self {
            Status::Success => "the command succeeded",
            Status::Negative => {
                "the answer is negative: verify found a disagreement, list a damaged index, or\n     \
                 health a server that does not serve"
            }
            Status::Usage => {
                "the command line is wrong, or a file of certificates or tokens cannot be read; nothing\n     \
                 was sent"
            }
            Status::Failed => {
                "the command failed: the server refused a call, TLS refused a certificate, another file\n     \
                 cannot be read or written, or a signal ended load or the writing of a file"
            }
            Status::NoAnswer => {
                "no server was reached, it did not answer in time, or it answered UNAVAILABLE"
            }
        }
    }

    /// The paragraph of the help text.
    pub(super) fn help() -> String {
        let lines = Status::ALL.map(|status| format!("  {}  {}\n", status as u8, status.meaning()));
        format!("Exit status:\n{}", lines.concat())
    }
}

impl From<Status> for ExitCode {
    fn from(status: Status) -> ExitCode {
        ExitCode::from(status as u8)
    }
}
