//! The contents of a failed call's status.

use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

/// A status with its details taken apart.
#[derive(Clone, Debug)]
pub struct Refusal {
    /// The code.
    pub code: Code,
    /// `ErrorInfo.reason`; empty if there is none.
    pub reason: String,
    /// The fields that `BadRequest` names, with what it says of each.
    pub fields: Vec<(String, String)>,
    /// The message.
    pub message: String,
    /// All details.
    pub details: ErrorDetails,
}

impl Refusal {
    /// Takes a status apart.
    ///
    /// # Panics
    /// If its details cannot be decoded, or it speaks for another domain than `wayfold`.
    pub fn of(status: &Status) -> Self {
        let details = status.check_error_details().expect("decodable details");
        let info = details.error_info();
        if let Some(info) = info {
            assert_eq!(info.domain, "wayfold");
        }
        let violations = details.bad_request().map(|bad| &bad.field_violations);
        Self {
            code: status.code(),
            reason: info.map(|info| info.reason.clone()).unwrap_or_default(),
            fields: violations
                .into_iter()
                .flatten()
                .map(|field| (field.field.clone(), field.description.clone()))
                .collect(),
            message: status.message().to_owned(),
            details,
        }
    }
}
