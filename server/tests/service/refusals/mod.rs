//! Each kind of bad input is refused with its code, reason and field, and leaves the index unchanged.

use std::fmt::Debug;

use wayfold_server::service::{Code, Error};

use crate::support::refusal;

mod mutations;
mod reads;
mod states;

/// A change that makes a good request bad, with the reason of the refusal and the field that it names.
type Fault<Request> = (fn(&mut Request), &'static str, &'static str);

/// Asserts that the call refuses the request with each of these faults alone.
async fn assert_faults<Request: Clone, T: Debug>(
    good: &Request,
    faults: &[Fault<Request>],
    call: impl AsyncFn(Request) -> Result<T, Error>,
) {
    for (spoil, reason, field) in faults {
        let mut bad = good.clone();
        spoil(&mut bad);
        assert_invalid(call(bad).await, reason, field);
    }
}

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

/// Asserts the refusals of a call for another uid and of a call for an unknown index.
fn assert_elsewhere<T: Debug>(other_uid: Result<T, Error>, unknown: Result<T, Error>) {
    let (code, reason, _) = refusal(other_uid);
    assert_eq!((code, reason), (Code::FailedPrecondition, "UID_MISMATCH"));
    let (code, reason, _) = refusal(unknown);
    assert_eq!((code, reason), (Code::NotFound, "INDEX_NOT_FOUND"));
}
