//! The rows of an insert that took effect before it failed.

use std::ops::Range;

use wayfold::Error;

use super::Failure;

/// Adds which rows of the file took effect before the failure in the call of `call`, and which may have.
pub(crate) fn stopped(call: Range<usize>, rows: usize, failure: Failure) -> Failure {
    let (done, source) = match failure {
        Failure::Client(Error::Partial { done, source, .. }) => {
            (call.start + done, Failure::Client(*source))
        }
        failure => (call.start, failure),
    };
    let is_unknown = matches!(&source, Failure::Client(error) if error.may_have_taken_effect());
    let unknown = format!(
        "rows {} to {} of {rows} may have taken effect",
        done + 1,
        call.end
    );
    let done = match (done, is_unknown) {
        (0, false) => return source,
        (0, true) => unknown,
        (_, false) => format!("the first {done} of {rows} rows took effect"),
        (_, true) => format!("the first {done} of {rows} rows took effect, and {unknown}"),
    };
    Failure::Stopped {
        done,
        source: Box::new(source),
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn rows_whose_outcome_is_unknown_are_named() {
        let late = || Error::Timeout {
            call: "insert",
            timeout: Duration::from_secs(5),
            earlier: None,
        };
        let text = |call, error: Error| stopped(call, 4000, error.into()).to_string();
        assert_eq!(
            text(0..1000, late()),
            format!(
                "rows 1 to 1000 of 4000 may have taken effect; then: {}",
                late()
            )
        );
        let partial = Error::Partial {
            done: 200,
            rows: 1000,
            ids: Vec::new(),
            source: Box::new(late()),
        };
        assert!(text(2000..3000, partial).starts_with(
            "the first 2200 of 4000 rows took effect, and rows 2201 to 3000 of 4000 may have taken effect; then: "
        ));
    }
}
