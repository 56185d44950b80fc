//! The trace that the calls of a task belong to.

use tonic::metadata::{Ascii, MetadataMap, MetadataValue};

use crate::Error;

/// The header of W3C Trace Context, level 1.
const TRACEPARENT: &str = "traceparent";

tokio::task_local! {
    static CONTEXT: MetadataValue<Ascii>;
}

/// Awaits `calls` as a part of a trace. Each call to a server that they make has the header `traceparent` of W3C Trace
/// Context, and the server's log lines of the call name its trace. Tasks that `calls` spawn do not belong to it, nor do
/// the threads of a shared index.
///
/// ```no_run
/// # async fn search(index: wayfold::IndexHandle) -> Result<(), wayfold::Error> {
/// let traceparent = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01";
/// let found = wayfold::in_trace(traceparent, async { index.knn([[0.5]]).k(10).await }).await??;
/// # Ok(())
/// # }
/// ```
///
/// # Errors
/// [`Error::Argument`]: no header has such characters.
pub async fn in_trace<F: Future>(traceparent: &str, calls: F) -> Result<F::Output, Error> {
    let value = traceparent.parse().map_err(|_| Error::Argument {
        field: TRACEPARENT,
        problem: "it has characters that no header has".to_owned(),
    })?;
    Ok(CONTEXT.scope(value, calls).await)
}

/// Adds the trace of this task to a call, if it has one.
pub(super) fn mark(metadata: &mut MetadataMap) {
    // An error means that there is no trace.
    let _ = CONTEXT.try_with(|context| metadata.insert(TRACEPARENT, context.clone()));
}
