//! Errors of the index as exceptions of the package.

use pyo3::{call::PyCallArgs, prelude::*, sync::PyOnceLock};
use wayfold::Error;

/// Turns the error of a call into an exception.
pub(crate) trait OrRaise<T> {
    /// The value, or an exception of the package.
    fn or_raise(self, py: Python<'_>) -> PyResult<T>;
}

impl<T> OrRaise<T> for Result<T, Error> {
    fn or_raise(self, py: Python<'_>) -> PyResult<T> {
        self.map_err(|error| {
            let code = upper_snake(&format!("{:?}", error.code()));
            let kind = match &error {
                Error::Forked => "FORKED",
                Error::NotInMemory { .. } => "NOT_IN_MEMORY",
                _ => &code,
            };
            let (reason, message) = (error.reason().unwrap_or_default(), error.to_string());
            match &error {
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
        })
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
