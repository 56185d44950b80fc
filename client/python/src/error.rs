//! Errors of the index as exceptions of the package, and exceptions of signal handlers while a call waits.

use std::cell::Cell;

use pyo3::{call::PyCallArgs, prelude::*, sync::PyOnceLock};
use wayfold::Error;

thread_local! {
    /// The exception that has interrupted the call of this thread.
    static RAISED: Cell<Option<PyErr>> = const { Cell::new(None) };
}

/// Runs the signal handlers of Python; true if one has raised, as that of Ctrl-C does. [`raised`] takes the exception.
pub(crate) fn is_interrupted() -> bool {
    // No handler runs once the interpreter ends.
    let error = Python::try_attach(|py| py.check_signals().err()).flatten();
    let is_raised = error.is_some();
    if is_raised {
        RAISED.set(error);
    }
    is_raised
}

/// Takes the exception that has interrupted the call of this thread.
pub(crate) fn raised() -> Option<PyErr> {
    RAISED.take()
}

/// Turns the error of a call into an exception.
pub(crate) trait OrRaise<T> {
    /// The value, or an exception of the package.
    fn or_raise(self, py: Python<'_>) -> PyResult<T>;
}

impl<T> OrRaise<T> for Result<T, Error> {
    fn or_raise(self, py: Python<'_>) -> PyResult<T> {
        self.map_err(|error| {
            let exception = exception(py, &error);
            match raised() {
                // The cause tells the rows that are stored.
                Some(raised) => {
                    raised.set_cause(py, Some(exception));
                    raised
                }
                None => exception,
            }
        })
    }
}

/// The exception of an error.
fn exception(py: Python<'_>, error: &Error) -> PyErr {
    let code = upper_snake(&format!("{:?}", error.code()));
    let kind = match error {
        Error::Forked => "FORKED",
        Error::NotInMemory { .. } => "NOT_IN_MEMORY",
        _ => &code,
    };
    let (reason, message) = (error.reason().unwrap_or_default(), error.to_string());
    match error {
        Error::Partial { done, ids, .. } => {
            let message = match reason {
                "" => message,
                reason => format!("{message}, reason {reason}"),
            };
            raise(
                py,
                (kind, code.as_str(), "PARTIAL", message, *done, &ids[..]),
            )
        }
        _ => raise(py, (kind, code.as_str(), reason, message)),
    }
}

/// A `ValueError` about an argument.
pub(crate) fn invalid(py: Python<'_>, message: &str) -> PyErr {
    raise(py, ("INVALID_ARGUMENT", "INVALID_ARGUMENT", "", message))
}

/// The exception that `make` makes of these arguments.
fn raise<'py>(py: Python<'py>, arguments: impl PyCallArgs<'py>) -> PyErr {
    static MAKE: PyOnceLock<Py<PyAny>> = PyOnceLock::new();
    let make = MAKE.import(py, "wayfold._errors", "make");
    match make.and_then(|make| make.call1(arguments)) {
        Ok(exception) => PyErr::from_value(exception),
        Err(error) => error,
    }
}

/// `InvalidArgument` as `INVALID_ARGUMENT`.
fn upper_snake(name: &str) -> String {
    let mut text = String::with_capacity(name.len() + 4);
    for (at, letter) in name.chars().enumerate() {
        if at > 0 && letter.is_ascii_uppercase() {
            text.push('_');
        }
        text.push(letter.to_ascii_uppercase());
    }
    text
}
