//! Streams of frames: their places, their turns, and the memory of what is not yet read.

use std::{convert::Infallible, sync::Arc, time::Duration};

use axum::{
    body::Body,
    http::{header, request::Parts},
    response::{IntoResponse, Response},
};
use bytes::Bytes;
use futures_util::stream;
use serde_json::{Value, json};
use tokio::sync::OwnedSemaphorePermit;
use tracing::Instrument;

use super::{
    api::{Admitted, Api, refusal, text, unread},
    frame::Frames,
};
use crate::{
    admission::CallTurns,
    observe::Ending,
    service::Error,
    status::{self, Status},
};

/// The most streams at a time. They leave connections for probes and scrapes.
pub(super) const MAX_STREAMS: usize = 16;

/// A stream says at least this often that it lives: the page gives up one that is silent for 25 seconds.
pub(super) const MAX_SILENCE: Duration = Duration::from_secs(10);

/// The call of a stream.
pub(super) struct StreamCall {
    pub(super) api: Arc<Api>,
    pub(super) admitted: Admitted,
    is_ended: bool,
    _place: OwnedSemaphorePermit,
}

/// A source of frames.
pub(super) trait FrameSource: Send + 'static {
    /// The next frames; None at the end.
    fn next(
        &mut self,
        call: &mut StreamCall,
    ) -> impl Future<Output = Result<Option<Frames>, Status>> + Send;
}

impl StreamCall {
    /// Admits a stream, if a place is free.
    pub(super) fn admit(
        api: &Arc<Api>,
        verb: &'static str,
        request: &Parts,
    ) -> Result<Self, Box<Status>> {
        let place = Arc::clone(&api.streams).try_acquire_owned();
        let place = place.map_err(|_| {
            api.shared.admission.count_excess();
            let advice = "close other tabs of the page, or try again later";
            status::too_many_calls("streams", MAX_STREAMS, advice)
        })?;
        Ok(Self {
            admitted: api.admit(verb, request, true)?,
            api: Arc::clone(api),
            is_ended: false,
            _place: place,
        })
    }

    /// The next frames of `source`, and those of its failure; None at the end.
    async fn next(&mut self, source: &mut impl FrameSource) -> Option<Bytes> {
        if self.is_ended {
            return None;
        }
        let frames = match source.next(self).await {
            Ok(Some(frames)) => frames,
            Ok(None) => {
                self.end(Ending::Ok);
                return None;
            }
            Err(status) => {
                self.end(Ending::Failed(status.code));
                let mut frames = Frames::default();
                let status: Value = serde_json::from_slice(&text(&status)).unwrap_or_default();
                frames.push(&json!({ "kind": "failed", "status": status }), &[]);
                frames
            }
        };
        Some(self.count(frames))
    }

    /// The bytes of `frames`, counted until they are written.
    fn count(&self, frames: Frames) -> Bytes {
        let held = Arc::new(self.admitted.held.flow().hold());
        unread(frames.finish(), held, Vec::new())
    }

    pub(super) fn end(&mut self, ending: Ending) {
        self.is_ended = true;
        self.admitted.record.end(ending);
    }
}

/// Does a part of the work in a turn.
pub(super) async fn in_turn<T>(
    turns: &mut CallTurns,
    work: impl Future<Output = Result<T, Error>>,
) -> Result<T, Status> {
    let done = turns.run(work).await.map_err(status::overloaded)?;
    done.map_err(|error| status::from_error(&error))
}

/// Answers with the frames of `source`. A refusal before the first frame is a plain answer, not a stream.
pub(super) async fn answer(mut call: StreamCall, mut source: impl FrameSource) -> Response {
    let span = call.admitted.record.span().clone();
    let first = match source.next(&mut call).instrument(span.clone()).await {
        Ok(first) => call.count(first.unwrap_or_default()),
        Err(status) => {
            call.end(Ending::Failed(status.code));
            return refusal(&status);
        }
    };
    let rest = stream::unfold((call, source), move |(mut call, mut source)| {
        let span = span.clone();
        async move {
            let frames = call.next(&mut source).instrument(span).await?;
            Some((frames, (call, source)))
        }
    });
    let frames = futures_util::StreamExt::chain(stream::iter([first]), rest);
    let frames = futures_util::StreamExt::map(frames, Ok::<_, Infallible>);
    let headers = [
        (header::CONTENT_TYPE, "application/octet-stream"),
        (header::CACHE_CONTROL, "no-store"),
    ];
    (headers, Body::from_stream(frames)).into_response()
}
