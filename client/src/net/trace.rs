//! The trace that the calls of a task belong to.

use tonic::metadata::{Ascii, MetadataMap, MetadataValue};

use crate::Error;

/// The header of W3C Trace Context, level 1.
const TRACEPARENT: &str = "traceparent";

tokio::task_local! {
    static CONTEXT: MetadataValue<Ascii>;
}

/// Awaits `calls` as a part of a trace. Each call to a server that they make has the `traceparent` of W3C Trace Context,
/// as a header of gRPC or in the attachment over Zenoh, and the server's log lines of the call name its trace. The calls
/// of an [`Index`](crate::Index) belong to it too; a shared index sends its writes and follows its server in the trace in
/// which it was opened. Tasks that `calls` spawn do not belong to it.
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
/// [`Error::Argument`]: it has other characters than lower-case hexadecimal digits and hyphens.
pub async fn in_trace<F: Future>(traceparent: &str, calls: F) -> Result<F::Output, Error> {
    let is_allowed = |byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f' | b'-');
    let value = traceparent.parse().ok();
    let value = value.filter(|_| traceparent.bytes().all(is_allowed));
    let value = value.ok_or_else(|| Error::Argument {
        field: TRACEPARENT,
        problem: "it has other characters than lower-case hexadecimal digits and hyphens"
            .to_owned(),
    })?;
    Ok(CONTEXT.scope(value, calls).await)
}

/// Awaits `calls`, on whatever task, as a part of the trace of the present one.
pub(crate) fn in_same_trace<F: Future>(calls: F) -> impl Future<Output = F::Output> {
    let context = current();
    async move {
        match context {
            Some(context) => CONTEXT.scope(context, calls).await,
            None => calls.await,
        }
    }
}

/// The `traceparent` of this task, if it has one.
fn current() -> Option<MetadataValue<Ascii>> {
    CONTEXT.try_with(Clone::clone).ok()
}

/// Adds the trace of this task to a call, if it has one.
pub(super) fn mark(metadata: &mut MetadataMap) {
    if let Some(context) = current() {
        metadata.insert(TRACEPARENT, context);
    }
}

/// The trace of this task as a parameter of a query's attachment.
#[cfg(feature = "zenoh")]
pub(super) fn parameter() -> Option<String> {
    let context = current()?;
    Some(format!("{TRACEPARENT}={}", context.to_str().ok()?))
}
