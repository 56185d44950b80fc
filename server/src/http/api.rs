//! The verbs that read, in JSON: `POST /api/v1/INDEX/VERB` and `POST /api/v1/VERB` take the messages that Zenoh takes.
//!
//! Nothing is changed here: a page of another origin that finds a way to this listener finds nothing to write with.

use std::{
    panic::AssertUnwindSafe,
    sync::Arc,
    time::{Duration, Instant},
};

use axum::{
    body::Body,
    extract::{Request as HttpRequest, State},
    http::{StatusCode, header, request::Parts},
    response::{IntoResponse, Response},
};
use bytes::{Bytes, BytesMut};
use futures_util::FutureExt;
use http_body_util::BodyExt;
use tokio::sync::Semaphore;
use tokio_util::task::{TaskTracker, task_tracker::TaskTrackerToken};
use tracing::Instrument;

use super::{Pages, streams::MAX_STREAMS};
use crate::{
    admission::{CALL_BYTES, CallTurns, Flow, HeldBytes},
    faces::{self, Addresses, FaceContext},
    identity::Denial,
    observe::{CallRecord, Ending, Times},
    service::{Call, Code, Error},
    status::{self, Status},
    verbs::{Form, MAX_DYNAMIC_BYTES, Request, Target, dispatch, invalid},
};

/// The keys begin with it.
pub(super) const PREFIX: &str = "/api/v1";

/// The most calls under way at a time: a connection of HTTP/2 has many, and each of them makes an answer.
pub(super) const MAX_CALLS: usize = 16;

/// The time of a call.
const MAX_TIME: Duration = Duration::from_secs(10);

/// The state that the calls of this listener share.
pub(super) struct Api {
    pub(super) shared: FaceContext,
    /// All of them take the turns and the memory of one connection, so that the page cannot slow planners.
    flow: Arc<Flow>,
    /// That of scrapes is one of administration: the load does not refuse them.
    pub(super) scrapes: Arc<Flow>,
    pub(super) calls: Semaphore,
    pub(super) streams: Arc<Semaphore>,
    pub(super) addresses: Arc<Addresses>,
    /// The calls that a stopping server finishes: no streams.
    under_way: TaskTracker,
    /// True if this listener speaks TLS.
    pub(super) has_tls: bool,
}

/// A call that was admitted.
pub(super) struct Admitted {
    pub(super) call: Call,
    pub(super) record: CallRecord,
    pub(super) held: Arc<HeldBytes>,
    pub(super) turns: CallTurns,
    /// Keeps the connection open, and the server from ending.
    active: Vec<TaskTrackerToken>,
}

/// The bytes of an answer that its client has not read. They are dropped once they are written.
struct UnreadBytes {
    bytes: Vec<u8>,
    _held: Arc<HeldBytes>,
    _active: Vec<TaskTrackerToken>,
}

impl AsRef<[u8]> for UnreadBytes {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

/// Holds the buffer of an answer until it is written, and its connection open. The body of a response ends before that.
pub(super) fn unread(bytes: Vec<u8>, held: Arc<HeldBytes>, active: Vec<TaskTrackerToken>) -> Bytes {
    held.force_take(bytes.capacity());
    Bytes::from_owner(UnreadBytes {
        bytes,
        _held: held,
        _active: active,
    })
}

impl Api {
    pub(super) fn new(pages: &Pages, has_tls: bool) -> Self {
        Self {
            flow: pages.shared.admission.open(),
            scrapes: Arc::clone(pages.shared.admission.open().admin()),
            calls: Semaphore::new(MAX_CALLS),
            streams: Arc::new(Semaphore::new(MAX_STREAMS)),
            shared: pages.shared.clone(),
            addresses: Arc::clone(&pages.addresses),
            under_way: pages.under_way.clone(),
            has_tls,
        }
    }

    /// Admits a call that arrived now. `is_stream` lets it last.
    pub(super) fn admit(
        &self,
        verb: &'static str,
        request: &Parts,
        is_stream: bool,
    ) -> Result<Admitted, Box<Status>> {
        let arrived = Instant::now();
        let mut call = super::call(&self.shared.identities, request);
        call.permits = Some(self.flow.permits());
        if !is_stream {
            call.has_default_deadline = true;
            call.deadline = arrived.checked_add(MAX_TIME);
        }
        let mut record = CallRecord::begin(
            format!("Http/{verb}"),
            "http",
            verb,
            arrived,
            &self.shared.metrics,
            &call,
        );
        let held = Arc::new(self.flow.hold());
        // The frames of a stream count on their own.
        call.held = (!is_stream).then(|| Arc::clone(&held));
        let mut turns = match is_stream {
            true => self.flow.turns_of_stream(),
            false => self.flow.turns(),
        };
        let refused = match call.caller.check() {
            Err(why) => Some(status::from_error(&Error::Denied {
                why: Denial::Unknown(why),
            })),
            Ok(()) if !held.take(CALL_BYTES) => Some(status::too_many_bytes(self.flow.max_bytes())),
            Ok(()) => turns.request().err().map(status::overloaded),
        };
        if let Some(status) = refused {
            record.end(Ending::Failed(status.code));
            return Err(status.into());
        }
        let mut active = Vec::from_iter(super::active(request));
        // A stop waits for none that comes after it.
        if !is_stream && !self.under_way.is_closed() {
            active.push(self.under_way.token());
        }
        Ok(Admitted {
            active,
            call,
            record,
            held,
            turns,
        })
    }
}

/// Answers a verb.
pub(super) async fn answer(State(api): State<Arc<Api>>, request: HttpRequest) -> Response {
    let (parts, body) = request.into_parts();
    let target = Target::of_reader(PREFIX, parts.uri.path());
    let verb = target.as_ref().map_or("other", |it| it.verb.name());
    let admitted = match api.admit(verb, &parts, false) {
        Ok(admitted) => admitted,
        Err(status) => return refusal(&status),
    };
    let Admitted {
        call,
        mut record,
        held,
        mut turns,
        active,
    } = admitted;
    let arrived = Instant::now();
    let span = record.span().clone();
    let mut received = Duration::ZERO;
    let answering = async {
        turns.give_up();
        let body = receive(body, &held).await?;
        received = arrived.elapsed();
        let _place = api.calls.acquire().await;
        // Answers that were not read may have taken the room meanwhile.
        if !held.check_room(0) {
            return Err(status::too_many_bytes(held.flow().max_bytes()));
        }
        let working = ask(&api.shared, &call, target, parts.uri.query(), &body);
        turns.run(working).await.map_err(status::overloaded)?
    };
    let in_time = tokio::time::timeout(MAX_TIME, AssertUnwindSafe(answering).catch_unwind());
    let answered = match in_time.instrument(span).await {
        Ok(Ok(answered)) => answered,
        Ok(Err(_panic)) => Err(faces::panicked(record.rpc())),
        Err(_) => Err(faces::deadline_exceeded()),
    };
    let (queued, computed) = turns.times();
    let times = Times {
        received,
        queued,
        computed,
        answered: arrived.elapsed(),
    };
    record.took(times, &api.shared.slow_calls);
    match answered {
        Ok(answer) => {
            record.end(Ending::Ok);
            let media = [(header::CONTENT_TYPE, "application/json")];
            (media, unread(answer, held, active)).into_response()
        }
        Err(status) => {
            record.end(Ending::Failed(status.code));
            refused(&status, unread(text(&status), held, active))
        }
    }
}

/// The bytes of a request, held as they arrive.
async fn receive(mut body: Body, held: &HeldBytes) -> Result<Bytes, Status> {
    let refused = |reason, text| status::from_error(&invalid("body", reason, text));
    let mut received = BytesMut::new();
    while let Some(frame) = body.frame().await {
        let data = match frame.map(|frame| frame.into_data()) {
            Ok(Ok(data)) => data,
            // Trailers say nothing here.
            Ok(Err(_)) => continue,
            Err(error) => {
                let text = format!("it cannot be read: {error}");
                return Err(refused("UNREADABLE", text));
            }
        };
        if received.len() + data.len() > MAX_DYNAMIC_BYTES {
            let text = format!("it exceeds {MAX_DYNAMIC_BYTES} bytes");
            return Err(refused("TOO_LARGE", text));
        }
        if !held.take(data.len()) {
            return Err(status::too_many_bytes(held.flow().max_bytes()));
        }
        received.extend_from_slice(&data);
    }
    Ok(received.freeze())
}

async fn ask(
    shared: &FaceContext,
    call: &Call,
    target: Result<Target<'_>, Error>,
    query: Option<&str>,
    body: &[u8],
) -> Result<Vec<u8>, Status> {
    let answered = async {
        let target = target?;
        if target.verb.is_mutation() {
            let text = format!(
                "{} changes the server: use gRPC, Zenoh or the command line",
                target.verb.name()
            );
            return Err(invalid("key", "READ_ONLY", text));
        }
        if let Some(query) = query {
            let text = format!("{query:?}: the fields of a request go into its body");
            return Err(invalid("address", "UNKNOWN_PARAMETER", text));
        }
        let arrived = Instant::now();
        let (request, _) = Request::of(Form::Json, target.index, [], body.into(), arrived)?;
        dispatch(
            &shared.service,
            call,
            target.verb,
            &request,
            MAX_DYNAMIC_BYTES,
        )
        .await
    };
    answered.await.map_err(|error| status::from_error(&error))
}

/// A refusal, with its status as JSON.
pub(super) fn refusal(status: &Status) -> Response {
    refused(status, text(status).into())
}

fn refused(status: &Status, text: Bytes) -> Response {
    let code = http_code(status.code);
    let media = [(header::CONTENT_TYPE, "application/json")];
    let mut response = (code, media, text).into_response();
    if code == StatusCode::UNAUTHORIZED {
        let challenge = header::HeaderValue::from_static("Bearer");
        response
            .headers_mut()
            .insert(header::WWW_AUTHENTICATE, challenge);
    }
    response
}

/// A status as JSON.
pub(super) fn text(status: &Status) -> Vec<u8> {
    let text = Form::Json.write(&status.to_message());
    text.unwrap_or_else(|error| error.to_string().into_bytes())
}

/// The status of HTTP for a code, as in google/rpc/code.proto.
fn http_code(code: Code) -> StatusCode {
    match code {
        Code::InvalidArgument | Code::FailedPrecondition => StatusCode::BAD_REQUEST,
        Code::NotFound => StatusCode::NOT_FOUND,
        Code::AlreadyExists => StatusCode::CONFLICT,
        Code::ResourceExhausted => StatusCode::TOO_MANY_REQUESTS,
        Code::Unavailable => StatusCode::SERVICE_UNAVAILABLE,
        Code::DeadlineExceeded => StatusCode::GATEWAY_TIMEOUT,
        Code::Unauthenticated => StatusCode::UNAUTHORIZED,
        Code::PermissionDenied => StatusCode::FORBIDDEN,
        Code::DataLoss | Code::Internal => StatusCode::INTERNAL_SERVER_ERROR,
    }
}
