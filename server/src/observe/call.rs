//! The span of a call, its log line at the end, and the fields of its request.

use std::{fmt, sync::Arc, time::Instant};

use tracing::{Span, debug, error_span, field, warn};
use wayfold_proto::v1;

use super::{
    metrics::{EndedCall, IndexLabel, Metrics},
    slow::{SlowCalls, Times},
    sparse::SparseLines,
    trace::trace_ids,
};
use crate::{
    log::MAX_NAME_BYTES,
    service::{Call, Code},
};

/// The lines of calls that found damage: a damaged index fails all its calls.
static DAMAGE: SparseLines = SparseLines::new();

/// The lines of calls that failed by another fault of the server.
static FAULTS: SparseLines = SparseLines::new();

/// The end of a call.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Ending {
    /// It succeeded.
    Ok,
    /// It failed with an error of the service.
    Failed(Code),
    /// The caller left, or its connection was cut: the status had no reader.
    Left,
    /// The transport ended it with this status, by gRPC's number.
    Transport(i32),
}

impl Ending {
    /// The number of UNKNOWN. Only a fault of the server causes it.
    const UNKNOWN: i32 = 2;

    /// Its name in metrics.
    fn name(self) -> &'static str {
        match self {
            Ending::Ok => "OK",
            Ending::Failed(code) => code.name(),
            Ending::Left => "CANCELLED",
            Ending::Transport(_) => "TRANSPORT",
        }
    }

    fn is_fault(self) -> bool {
        match self {
            Ending::Failed(code) => matches!(code, Code::Internal | Code::DataLoss),
            Ending::Transport(number) => number == Self::UNKNOWN,
            Ending::Ok | Ending::Left => false,
        }
    }
}

impl fmt::Debug for Ending {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Ending::Ok => f.write_str("Ok"),
            Ending::Failed(code) => code.fmt(f),
            Ending::Left => f.write_str("Cancelled"),
            Ending::Transport(number) => write!(f, "gRPC {number}"),
        }
    }
}

/// A call from its arrival to the last byte of its answer. Its end is written when it is dropped: at `debug`, or at
/// `warn` when the fault is the server's, unless it had such a line just before.
pub(crate) struct CallRecord {
    rpc: String,
    started: Instant,
    span: Span,
    ending: Ending,
    times: Option<(SlowCalls, Times)>,
    metrics: Metrics,
    face: &'static str,
    verb: &'static str,
    index: IndexLabel,
}

impl CallRecord {
    /// A call of `verb` on a face that arrived at `started`. Log lines name it `rpc`, such as `PointService/Knn`, and have
    /// its caller, its peer, and the trace and the parent of its `traceparent`.
    pub(crate) fn begin(
        rpc: impl Into<String>,
        face: &'static str,
        verb: &'static str,
        started: Instant,
        metrics: &Metrics,
        call: &Call,
    ) -> Self {
        let rpc = rpc.into();
        let ids = call.trace.as_deref().and_then(trace_ids);
        Self {
            metrics: metrics.clone(),
            face,
            verb,
            index: Arc::clone(&call.index),
            // The lines of a call name it at every level of the filter.
            span: error_span!(
                "call",
                rpc,
                // A field that is recorded later costs a call more than one that is known here.
                identity = call.caller.name(),
                peer = call.peer.map(field::display),
                trace = ids.map(|(trace, _)| trace),
                parent = ids.map(|(_, parent)| parent),
                index = field::Empty,
                rows = field::Empty
            ),
            rpc,
            started,
            ending: Ending::Left,
            times: None,
        }
    }

    /// The name of the called method.
    pub(crate) fn rpc(&self) -> &str {
        &self.rpc
    }

    /// The span to do the call's work in.
    pub(crate) fn span(&self) -> &Span {
        &self.span
    }

    /// Notes the parts of the call's time, for a line if it turns out to be slow.
    pub(crate) fn took(&mut self, times: Times, slow_calls: &SlowCalls) {
        self.times = Some((slow_calls.clone(), times));
    }

    /// Sets the outcome of the call.
    pub(crate) fn end(&mut self, ending: Ending) {
        self.ending = ending;
    }
}

impl Drop for CallRecord {
    fn drop(&mut self) {
        let code = self.ending;
        let whole = self.started.elapsed();
        if let Some((slow_calls, times)) = &self.times {
            slow_calls.report(&self.span, whole, times);
        }
        self.metrics.count(&EndedCall {
            face: self.face,
            verb: self.verb,
            index: &self.index,
            outcome: code.name(),
            took: whole,
            queued: self.times.as_ref().map(|(_, times)| times.queued),
        });
        let duration_us = u64::try_from(whole.as_micros()).unwrap_or(u64::MAX);
        let lines = match code {
            Ending::Failed(Code::DataLoss) => &DAMAGE,
            _ => &FAULTS,
        };
        match code.is_fault().then(|| lines.next()).flatten() {
            Some(left_out) => {
                warn!(parent: &self.span, ?code, duration_us, left_out, "call failed");
            }
            None => debug!(parent: &self.span, ?code, duration_us, "call ended"),
        }
    }
}

/// A request that names its index and counts its rows or ids.
pub(crate) trait Request {
    /// The name of the index; empty for none.
    fn index(&self) -> &str {
        ""
    }

    /// The field for the name of the index, if the request has one.
    fn index_mut(&mut self) -> Option<&mut String> {
        None
    }

    /// The number of rows or ids that it carries, if the call has any.
    fn rows(&self) -> Option<usize> {
        None
    }
}

/// Records the index and the rows of a request in the current call's span. No check has bounded the name yet, so that it is
/// cut at the longest one of an index.
pub(crate) fn request(request: &impl Request) {
    let span = Span::current();
    let index = request.index();
    if !index.is_empty() {
        span.record("index", &index[..index.floor_char_boundary(MAX_NAME_BYTES)]);
    }
    if let Some(rows) = request.rows() {
        span.record("rows", rows);
    }
}

macro_rules! requests {
    ($($message:ident $(: $index:ident $(, $this:ident => $rows:expr)?)?;)*) => {
        $(impl Request for v1::$message {
            $(fn index(&self) -> &str {
                &self.$index
            }

            fn index_mut(&mut self) -> Option<&mut String> {
                Some(&mut self.$index)
            }

            $(fn rows(&self) -> Option<usize> {
                let $this = self;
                Some($rows)
            })?)?
        })*
    };
}

requests! {
    InsertRequest: index_name, this => rows(this.states.as_ref());
    UpdateRequest: index_name, this => this.ids.len();
    RemoveRequest: index_name, this => this.ids.len();
    OpenSessionRequest: index_name;
    WriteRequest: index_name, this => this.kinds.len();
    GetRequest: index_name, this => this.ids.len();
    KnnRequest: index_name, this => rows(this.states.as_ref());
    QueryRequest: index_name, this => rows(this.states.as_ref());
    ScanRequest: index_name;
    WatchRequest: index_name;
    GetServerRequest;
    CreateIndexRequest: name;
    GetIndexRequest: index_name;
    ListIndexesRequest;
    DeleteIndexRequest: index_name;
    SnapshotIndexRequest: index_name;
    RestoreIndexRequest: name;
    VerifyIndexRequest: index_name;
}

fn rows(states: Option<&v1::States>) -> usize {
    states.map_or(0, |states| states.row_count as usize)
}
