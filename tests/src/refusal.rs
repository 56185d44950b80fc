//! The contents of a failed call's status.

use tonic::{Code, Status};
use tonic_types::StatusExt;

/// A status with its decoded details.
#[derive(Clone, Debug)]
pub struct Refusal {
    /// The code.
    pub code: Code,
    /// `ErrorInfo.reason`; empty if there is none.
    pub reason: String,
    /// The message.
    pub message: String,
}

impl Refusal {
    /// Decodes a status.
    ///
    /// # Panics
    /// If its details cannot be decoded, or its domain is not `wayfold`.
    pub fn of(status: &Status) -> Self {
        let details = status.check_error_details().expect("decodable details");
        let info = details.error_info();
        if let Some(info) = info {
            assert_eq!(info.domain, "wayfold");
        }
        Self {
            code: status.code(),
            reason: info.map(|info| info.reason.clone()).unwrap_or_default(),
            message: status.message().to_owned(),
        }
    }
}
