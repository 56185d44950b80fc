//! One call's span and the line that records its end.

use std::time::Instant;

use tonic::Code;
use tracing::{Span, debug, field, info_span, warn};

/// A call from its arrival to the last byte of its answer. Its end is written when it is dropped: at `debug`, or at
/// `warn` when the fault is the server's.
pub(crate) struct CallRecord {
    rpc: String,
    started: Instant,
    span: Span,
    code: Option<Code>,
}

impl CallRecord {
    /// A call of `rpc`, such as `PointService/Knn`, that arrived at `started`.
    pub(crate) fn begin(rpc: impl Into<String>, started: Instant) -> Self {
        let rpc = rpc.into();
        Self {
            span: info_span!("call", rpc, index = field::Empty, rows = field::Empty),
            rpc,
            started,
            code: None,
        }
    }

    /// The name of what is called.
    pub(crate) fn rpc(&self) -> &str {
        &self.rpc
    }

    /// The span to do the call's work in.
    pub(crate) fn span(&self) -> &Span {
        &self.span
    }

    /// Says how the call ended.
    pub(crate) fn end(&mut self, code: Code) {
        self.code = Some(code);
    }
}

impl Drop for CallRecord {
    fn drop(&mut self) {
        // Nobody waited for a call that goes without a status: its client left, or its connection was cut.
        let code = self.code.unwrap_or(Code::Cancelled);
        let duration_us = u64::try_from(self.started.elapsed().as_micros()).unwrap_or(u64::MAX);
        match code {
            Code::Internal | Code::DataLoss | Code::Unknown => {
                warn!(parent: &self.span, ?code, duration_us, "call failed");
            }
            _ => debug!(parent: &self.span, ?code, duration_us, "call ended"),
        }
    }
}

/// Notes in the current call's span which index it concerns.
pub(crate) fn index(name: &str) {
    Span::current().record("index", name);
}

/// Notes in the current call's span how many rows or ids its request carries.
pub(crate) fn rows(count: usize) {
    Span::current().record("rows", count);
}
