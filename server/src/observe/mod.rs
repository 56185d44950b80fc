//! Log lines on standard error, and a span with an outcome for every call.

mod call;
mod logging;
mod metrics;
mod slow;
mod sparse;
mod trace;

pub(crate) use call::{CallRecord, Ending, Request, request};
pub(crate) use logging::start;
pub use logging::{LogFormat, LoggingError};
pub(crate) use metrics::{MAX_SCRAPES, Metrics};
pub(crate) use slow::{SlowCalls, Times};
pub(crate) use sparse::SparseLines;
pub(crate) use trace::trace_ids;
