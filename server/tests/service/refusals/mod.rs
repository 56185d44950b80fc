//! Every kind of bad input has its code, its reason and its field, and leaves the index as it was.

use std::fmt::Debug;

use wayfold_server::service::{Code, Error};

use crate::support::refusal;

mod mutations;
mod reads;
mod states;

/// Asserts that a call is refused for one field, which the message names.
fn assert_invalid<T: Debug>(answer: Result<T, Error>, reason: &'static str, field: &str) {
    let error = answer.unwrap_err();
    let text = error.to_string();
    let Error::InvalidArgument { violations } = error else {
        panic!("{text}");
    };
    let [violation] = &violations[..] else {
        panic!("{text}");
    };
    assert_eq!((violation.reason, &*violation.field), (reason, field));
    assert!(text.contains(field), "{text}");
}

/// Asserts the refusals of a call for another uid, and of a call for an index that is not there.
fn assert_elsewhere<T: Debug>(other_uid: Result<T, Error>, unknown: Result<T, Error>) {
    let (code, reason, _) = refusal(other_uid);
    assert_eq!((code, reason), (Code::FailedPrecondition, "UID_MISMATCH"));
    let (code, reason, _) = refusal(unknown);
    assert_eq!((code, reason), (Code::NotFound, "INDEX_NOT_FOUND"));
}
