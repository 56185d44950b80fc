//! `POST /api/v1/overview`: all indices and the figures of `/metrics`, each second, as frames. `POST /api/v1/addresses`: where
//! the server is reached.

use std::{net::SocketAddr, sync::Arc, time::Duration};

use axum::{
    extract::State,
    http::{header, request::Parts},
    response::{IntoResponse, Response},
};
use prost::Message;
use serde_json::{Value, json};
use tokio::time::{Instant, sleep_until};
use wayfold_proto::v1;

use super::{
    api::{Admitted, Api, refusal},
    frame::Frames,
    metrics_text,
    streams::{self, FrameSource, MAX_SILENCE, StreamCall},
};
use crate::{
    observe::Ending,
    service::{Call, Error, Service},
    status::{self, Status},
    verbs::{Form, at_length},
};

/// The time between two frames.
const PERIOD: Duration = Duration::from_secs(1);

/// The frames of a stream take the server at most one in this many parts of the time, as far as [`MAX_SILENCE`] allows.
const MAX_SHARE: u32 = 10;

/// Answers with the addresses that the server listens on.
pub(super) async fn addresses(State(api): State<Arc<Api>>, request: Parts) -> Response {
    match api.admit("addresses", &request, false) {
        Ok(mut admitted) => {
            admitted.record.end(Ending::Ok);
            let at = &api.addresses;
            let http = |at: SocketAddr| json!({ "address": at, "has_tls": api.has_tls });
            let text = json!({
                "grpc": { "address": at.grpc, "has_tls": at.has_tls },
                "http": at.pages.map(http),
                "has_identities": at.has_identities,
            });
            let media = [(header::CONTENT_TYPE, "application/json")];
            (media, text.to_string()).into_response()
        }
        Err(status) => refusal(&status),
    }
}

/// Answers with the stream.
pub(super) async fn overview(State(api): State<Arc<Api>>, request: Parts) -> Response {
    match StreamCall::admit(&api, "overview", &request) {
        Ok(call) => {
            streams::answer(
                call,
                Overview {
                    next: Instant::now(),
                },
            )
            .await
        }
        Err(status) => refusal(&status),
    }
}

/// The source of the frames.
struct Overview {
    /// The time of the next frame.
    next: Instant,
}

impl FrameSource for Overview {
    async fn next(&mut self, call: &mut StreamCall) -> Result<Option<Frames>, Status> {
        sleep_until(self.next).await;
        let began = Instant::now();
        let shared = call.api.shared.clone();
        let Admitted { call, turns, .. } = &mut call.admitted;
        let listed = streams::in_turn(turns, list(&shared.service, call)).await?;
        let metrics = match Service::authorize_metrics(call) {
            Ok(()) => Some(
                metrics_text(&shared)
                    .await
                    .map_err(|it| status::from_error(&it))?,
            ),
            Err(_) => None,
        };
        let bytes = listed.encoded_len() + metrics.as_ref().map_or(0, String::len);
        let making = async { at_length(bytes, || frame(&listed, metrics.as_deref())) };
        let frames = streams::in_turn(turns, making).await?;
        self.next = began + period_after(began.elapsed());
        Ok(Some(frames))
    }
}

/// The time from the start of a frame to that of the next one, if the frame took `elapsed`.
pub(super) fn period_after(elapsed: Duration) -> Duration {
    (MAX_SHARE * elapsed).clamp(PERIOD, MAX_SILENCE)
}

/// All indices that the caller sees, as one answer of the verb `list`.
async fn list(service: &Service, call: &Call) -> Result<v1::ListIndexesResponse, Error> {
    let mut whole = v1::ListIndexesResponse::default();
    let mut request = v1::ListIndexesRequest {
        page_size: 1000,
        ..Default::default()
    };
    loop {
        let page = service.list_indexes(call, request.clone()).await?;
        let page = status::listing(page);
        whole.indexes.extend(page.indexes);
        whole.damaged.extend(page.damaged);
        if page.next_page_token.is_empty() {
            return Ok(whole);
        }
        request.page_token = page.next_page_token;
    }
}

fn frame(listed: &v1::ListIndexesResponse, metrics: Option<&str>) -> Result<Frames, Error> {
    let text = Form::Json.write(listed)?;
    let listed: Value = serde_json::from_slice(&text).map_err(|error| Error::Internal {
        what: format!("the list of the indices is no JSON: {error}"),
    })?;
    let mut frames = Frames::default();
    let head = json!({ "kind": "overview", "list": listed, "metrics": metrics });
    frames.push(&head, &[]);
    Ok(frames)
}
