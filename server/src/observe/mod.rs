//! Log lines on standard error, and a span with an outcome for every call.

mod call;
mod logging;

pub(crate) use call::{CallRecord, index, rows};
pub(crate) use logging::start;
pub use logging::{LogFormat, LoggingError};
