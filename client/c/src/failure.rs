//! The error of a thread's last failed call.

use std::{
    any::Any,
    cell::RefCell,
    ffi::{CString, c_char},
    panic::{AssertUnwindSafe, catch_unwind},
};

use client::Error;

use crate::code::Code;

/// An error as C reads it.
#[derive(Debug)]
pub(crate) struct Failure {
    code: Code,
    pub(crate) message: CString,
    pub(crate) field: CString,
    pub(crate) reason: CString,
    /// The number of rows that took effect before the error.
    rows_done: usize,
}

thread_local! {
    static LAST: RefCell<Option<Failure>> = const { RefCell::new(None) };
}

impl Failure {
    pub(crate) fn new(code: Code, field: &str, reason: &str, message: &str) -> Failure {
        Failure {
            code,
            message: c_string(message),
            field: c_string(field),
            reason: c_string(reason),
            rows_done: 0,
        }
    }

    /// An argument that is out of its range.
    pub(crate) fn argument(field: &str, problem: &str) -> Failure {
        let message = format!("{field}: {problem}");
        Failure::new(Code::InvalidArgument, field, "INVALID_ARGUMENT", &message)
    }
}

impl From<Error> for Failure {
    fn from(error: Error) -> Failure {
        let (field, reason) = match &error {
            Error::Argument { field, problem } => {
                return Failure::argument(field_in_c(field), problem);
            }
            Error::Width { row, .. } => (format!("states[{row}]"), "WRONG_WIDTH"),
            Error::State { row, error } => (
                format!("states[{row}].coords[{}]", error.coordinate),
                "INVALID_STATE",
            ),
            Error::Address { .. } => ("uri".to_owned(), ""),
            Error::IdTaken { .. } => ("id".to_owned(), "ID_TAKEN"),
            Error::SearchTimeout => ("timeout".to_owned(), "SEARCH_TIMEOUT"),
            Error::NotInMemory { .. } => (String::new(), "NOT_IN_MEMORY"),
            Error::Closed => (String::new(), "CLOSED"),
            Error::Forked => (String::new(), "FORKED"),
            Error::Partial { done, source, .. } => return partial(&error, *done, source),
            #[cfg(feature = "net")]
            error => (refused_field(error), ""),
            #[cfg(not(feature = "net"))]
            _ => (String::new(), ""),
        };
        #[cfg(feature = "net")]
        let reason = error.reason().unwrap_or(reason);
        Failure::new(code(&error), &field, reason, &error.to_string())
    }
}

/// An error after `rows_done` rows took effect. Its field would count rows from there, and stays in the message.
fn partial(error: &Error, rows_done: usize, source: &Error) -> Failure {
    #[cfg(feature = "net")]
    let reason = source.reason().unwrap_or_default();
    #[cfg(not(feature = "net"))]
    let reason = "";
    let message = match reason {
        "" => error.to_string(),
        reason => format!("{error}, reason {reason}"),
    };
    Failure {
        rows_done,
        ..Failure::new(code(source), "", "PARTIAL", &message)
    }
}

/// The name that a search's argument has in C, where a search has no scaled radius of its own.
fn field_in_c(field: &str) -> &str {
    match field {
        "scaled_radius.factor" => "radius_factor",
        "scaled_radius.max" => "radius",
        _ => field,
    }
}

/// The first of the fields that the server has refused; "" if there are none.
#[cfg(feature = "net")]
fn refused_field(error: &Error) -> String {
    match error {
        Error::Refused(refusal) => {
            let first = refusal.fields.first();
            first.map_or_else(String::new, |violation| violation.field.clone())
        }
        Error::WritesRefused { why } | Error::Ended { why } => refused_field(why),
        _ => String::new(),
    }
}

#[cfg(not(feature = "net"))]
fn code(error: &Error) -> Code {
    match error {
        Error::IdTaken { .. } => Code::AlreadyExists,
        Error::SearchTimeout => Code::DeadlineExceeded,
        Error::Closed | Error::Forked => Code::FailedPrecondition,
        _ => Code::InvalidArgument,
    }
}

#[cfg(feature = "net")]
fn code(error: &Error) -> Code {
    match error.code() {
        // An error is never a success.
        client::Code::Ok | client::Code::Unknown => Code::Unknown,
        client::Code::Cancelled => Code::Cancelled,
        client::Code::InvalidArgument => Code::InvalidArgument,
        client::Code::DeadlineExceeded => Code::DeadlineExceeded,
        client::Code::NotFound => Code::NotFound,
        client::Code::AlreadyExists => Code::AlreadyExists,
        client::Code::PermissionDenied => Code::PermissionDenied,
        client::Code::ResourceExhausted => Code::ResourceExhausted,
        client::Code::FailedPrecondition => Code::FailedPrecondition,
        client::Code::Aborted => Code::Aborted,
        client::Code::OutOfRange => Code::OutOfRange,
        client::Code::Unimplemented => Code::Unimplemented,
        client::Code::Internal => Code::Internal,
        client::Code::Unavailable => Code::Unavailable,
        client::Code::DataLoss => Code::DataLoss,
        client::Code::Unauthenticated => Code::Unauthenticated,
    }
}

/// Runs the body of a function of the ABI, and keeps its error.
pub(crate) fn call(body: impl FnOnce() -> Result<(), Failure>) -> Code {
    match catch_unwind(AssertUnwindSafe(body)) {
        Ok(Ok(())) => Code::Ok,
        Ok(Err(failure)) => set_last_failure(failure),
        Err(panic) => set_last_failure(panicked(panic.as_ref())),
    }
}

fn set_last_failure(failure: Failure) -> Code {
    let code = failure.code;
    // At the end of a thread its last error is gone: calls of destructors still return their codes.
    let _ = LAST.try_with(|last| *last.borrow_mut() = Some(failure));
    code
}

fn panicked(panic: &(dyn Any + Send)) -> Failure {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    let text = text.or_else(|| panic.downcast_ref::<String>().cloned());
    let message = format!("the library panicked: {}", text.unwrap_or_default());
    Failure::new(Code::Internal, "", "PANIC", &message)
}

/// A part of the error of this thread's last failed call: "" if none has failed, and at the end of the thread.
pub(crate) fn last(part: fn(&Failure) -> &CString) -> *const c_char {
    let text = LAST.try_with(|last| {
        let last = last.borrow();
        let text = last.as_ref().map(part);
        text.map_or(c"".as_ptr(), |text| text.as_ptr())
    });
    text.unwrap_or(c"".as_ptr())
}

/// The number of rows that took effect before the error of this thread's last failed call.
pub(crate) fn last_rows_done() -> usize {
    let done = LAST.try_with(|last| {
        last.borrow()
            .as_ref()
            .map_or(0, |failure| failure.rows_done)
    });
    done.unwrap_or(0)
}

fn c_string(text: &str) -> CString {
    CString::new(text.replace('\0', " ")).unwrap_or_default()
}

/// Frees a value. A panic while it is dropped does not unwind into the caller.
pub(crate) fn free(body: impl FnOnce()) {
    let _ = catch_unwind(AssertUnwindSafe(body));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_is_an_error_with_its_text() {
        let place = String::from("place");
        let caught = |code| {
            assert_eq!(code, Code::Internal);
            LAST.take().expect("an error")
        };
        let plain = caught(call(|| panic!("a place")));
        let formatted = caught(call(|| panic!("a {place}")));
        for failure in [plain, formatted] {
            assert_eq!(failure.reason.as_c_str(), c"PANIC");
            assert_eq!(failure.message.as_c_str(), c"the library panicked: a place");
        }
    }
}
