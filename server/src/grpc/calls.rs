//! The layer around every call: its span, deadline, share of the server's time and memory, and the record of its end.
//!
//! A request arrives whole before its call waits for a turn, unless it is a stream. Health and reflection take no turns:
//! they must answer just when the server is busy. Nor does a path without a call.

mod admitted;
mod unauthenticated;

use std::{
    convert::Infallible,
    future::{pending, ready},
    pin::Pin,
    str::FromStr,
    sync::Arc,
    task::{Context, Poll},
    time::{Duration, Instant},
};

use bytes::Bytes;
use http::{HeaderMap, Request, Response, Uri, header};
use tokio::{
    sync::OwnedSemaphorePermit,
    time::{Interval, MissedTickBehavior, interval},
};
use tokio_util::task::TaskTracker;
use tonic::{Status, body::Body};
use tower::{Layer, Service};
use tracing::Instrument;

use admitted::Admitted;

use super::{
    body::CallResources,
    connections::Activity,
    deadline,
    refusals::{self, MessageLimit},
    request_body::RequestLimits,
    rpcs::Rpc,
    status::{ending, from_error},
};
use crate::{
    admission::{CALL_BYTES, Flow, HeldBytes},
    config::GrpcConfig,
    faces::FaceContext,
    identity::{Caller, Denial, IdentificationError},
    observe::{self, CallRecord},
    service::{Call, Error, Peer},
    status,
};

/// The service's context of a call, which the layer leaves in the request's extensions for the handler.
pub(crate) fn call_of<T>(request: &tonic::Request<T>) -> Call {
    let call = request.extensions().get::<Call>().cloned();
    // Without the layer there is no right.
    call.unwrap_or(Call {
        caller: Caller::Unknown(IdentificationError::NoCredential),
        ..Call::default()
    })
}

/// The bytes that a call holds at its begin. Its path and headers count as far as they are more than usual.
fn call_bytes(uri: &Uri, headers: &HeaderMap) -> usize {
    const USUAL_HEADERS: usize = 32;
    const ENTRY_BYTES: usize = 128;
    const USUAL_TEXT: usize = 1024;
    let path = uri.path_and_query().map_or(0, |path| path.as_str().len());
    let texts = headers
        .iter()
        .map(|(name, value)| name.as_str().len() + value.len());
    CALL_BYTES
        + headers.len().saturating_sub(USUAL_HEADERS) * ENTRY_BYTES
        + (path + texts.sum::<usize>()).saturating_sub(USUAL_TEXT)
}

/// The place of a call in a trace.
fn traceparent(headers: &HeaderMap) -> Option<&str> {
    headers.get("traceparent")?.to_str().ok()
}

/// The token of a call: `authorization: Bearer TOKEN`.
pub(crate) fn token(headers: &HeaderMap) -> Option<&[u8]> {
    const SCHEME: &[u8] = b"bearer ";
    let value = headers.get(header::AUTHORIZATION)?.as_bytes();
    let (scheme, token) = value.split_at_checked(SCHEME.len())?;
    scheme.eq_ignore_ascii_case(SCHEME).then_some(token)
}

/// The preamble of every handler: the context of the call, and its message, recorded in the call's span.
pub(crate) fn into_call<R: observe::Request>(request: tonic::Request<R>) -> (Call, R) {
    let (call, message) = (call_of(&request), request.into_inner());
    observe::request(&message);
    (call, message)
}

/// The times at which a stream that waits for its client looks at its caller.
pub(super) fn caller_checks() -> Interval {
    let mut checks = interval(Duration::from_secs(1));
    checks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    checks
}

/// Refuses a caller that is unknown by now.
pub(super) fn check_caller(call: &Call) -> Result<(), Status> {
    call.caller.check().map_err(|why| {
        let why = Denial::Unknown(why);
        from_error(&Error::Denied { why })
    })
}

/// The flow of a call, which the layer leaves in the extensions of the request.
pub(super) fn flow_of<T>(request: &tonic::Request<T>) -> Option<Arc<Flow>> {
    request.extensions().get::<Arc<Flow>>().cloned()
}

/// The header by which a member of the cluster names the identity of the caller whose call it forwards.
pub(super) const IDENTITY: &str = "wayfold-identity";

/// The header of a forwarded call with the number of its client at the server that forwards it.
pub(super) const CLIENT: &str = "wayfold-client";

/// The header of a forwarded call with the uid of its index at the server that forwards it.
pub(super) const UID: &str = "wayfold-uid";

/// The value of a header of a forwarded call; None if it is missing or malformed.
pub(super) fn forwarded<T: FromStr>(headers: &HeaderMap, name: &str) -> Option<T> {
    headers.get(name)?.to_str().ok()?.parse().ok()
}

/// The callers of a listener.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Callers {
    /// Clients, which show a credential.
    Clients,
    /// Members of the cluster, which are trusted and name the identity of their caller.
    Members,
}

/// The most calls of a member's connection.
const MAX_CALLS_OF_MEMBERS: u32 = 256;

/// Wraps services in [`Calls`].
#[derive(Clone)]
pub(super) struct CallsLayer {
    shared: FaceContext,
    callers: Callers,
    /// The calls under way.
    under_way: TaskTracker,
    /// The most calls of a connection.
    max_calls: u32,
    requests: RequestLimits,
    /// The deadline of calls that have none and are no streams.
    default_timeout: Duration,
    /// The headers of the refusal of a call that would wait for too long.
    overloaded: Arc<HeaderMap>,
}

impl Callers {
    /// The most calls of one connection: another member sends the calls of all its clients over one.
    pub(super) fn max_calls(self, config: &GrpcConfig) -> u32 {
        match self {
            Self::Clients => config.max_calls_per_connection,
            Self::Members => MAX_CALLS_OF_MEMBERS,
        }
    }
}

impl CallsLayer {
    /// The layer of these settings, which counts its calls in `under_way`.
    pub(super) fn new(
        config: &GrpcConfig,
        shared: FaceContext,
        callers: Callers,
        under_way: TaskTracker,
    ) -> Self {
        let overloaded = status::overloaded(shared.admission.overloaded());
        Self {
            shared,
            callers,
            under_way,
            max_calls: callers.max_calls(config),
            requests: RequestLimits {
                message: MessageLimit::of_setting(config.max_message_bytes),
                time: Duration::from_millis(config.receive_timeout_ms),
                may_pause: false,
            },
            default_timeout: Duration::from_millis(config.default_timeout_ms),
            overloaded: Arc::new(refusals::headers(overloaded)),
        }
    }
}

impl<S> Layer<S> for CallsLayer {
    type Service = Calls<S>;

    fn layer(&self, inner: S) -> Calls<S> {
        Calls {
            inner,
            settings: self.clone(),
        }
    }
}

/// See the module.
#[derive(Clone)]
pub(super) struct Calls<S> {
    inner: S,
    settings: CallsLayer,
}

type ResponseFuture = Pin<Box<dyn Future<Output = Result<Response<Body>, Infallible>> + Send>>;

impl<S> Service<Request<Body>> for Calls<S>
where
    S: Service<Request<Body>, Response = Response<Body>, Error = Infallible>
        + Clone
        + Send
        + 'static,
    S::Future: Send + 'static,
{
    type Response = Response<Body>;
    type Error = Infallible;
    type Future = ResponseFuture;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: Request<Body>) -> ResponseFuture {
        let (path, settings) = (request.uri().path(), &self.settings);
        let Some(rpc) = Rpc::of(path) else {
            return match unauthenticated::is_unauthenticated(path) {
                true => Box::pin(unauthenticated::answer(
                    self.inner.clone(),
                    request,
                    settings,
                )),
                false => Box::pin(self.inner.call(request)),
            };
        };
        let activity = request.extensions().get::<Activity>().cloned();
        let active = match activity.as_ref().map(Activity::begin) {
            // The connection is being cut, and its calls with it.
            Some(None) => return Box::pin(pending()),
            begun => begun.flatten(),
        };
        let is_of_admin = rpc.is_of_indices() && rpc.is_unary();
        if !is_of_admin && let Some(Err(limit)) = activity.as_ref().map(Activity::check_place) {
            settings.shared.admission.count_excess();
            let refused: Status = refusals::too_many_connections(limit).into();
            return Box::pin(ready(Ok(refused.into_http())));
        }
        let flow = settings.flow(is_of_admin, activity.as_ref());
        // A call waits from its arrival on, not from the time that its task first runs.
        let mut turns = flow.turns();
        if turns.request().is_err() {
            // Under overload most calls end here: this must cost next to nothing.
            let mut refusal = Response::new(Body::empty());
            *refusal.headers_mut() = HeaderMap::clone(&settings.overloaded);
            return Box::pin(ready(Ok(refusal)));
        }
        // The clock starts here, not inside the future: after this function returns, tonic starts its own timer for the
        // same header and answers CANCELLED when it ends. Ours must never be the later one.
        let arrived = Instant::now();
        let mut call = settings.context(request.headers(), activity.as_ref(), &flow);
        let (face, metrics) = (settings.face(), &settings.shared.metrics);
        let mut record = CallRecord::begin(rpc.path, face, rpc.verb, arrived, metrics, &call);
        let held = Arc::new(flow.hold());
        // The parts of a stream count on their own.
        call.held = rpc.is_unary().then(|| Arc::clone(&held));
        let stream = match settings.admit(rpc, &request, arrived, &held, &mut call) {
            Ok(stream) => stream,
            Err(status) => {
                record.end(ending(status.code()));
                return Box::pin(ready(Ok(status.into_http())));
            }
        };
        let resources = CallResources {
            activity,
            _active: active,
            _stream: stream,
            // A `Watch` ends at a stop and loses nothing, so the stop does not wait for a client that does not read.
            _under_way: (!rpc.is_watch()).then(|| settings.under_way.token()),
            held: Arc::clone(&held),
        };
        let admitted = Admitted {
            inner: self.inner.clone(),
            limits: settings.requests(rpc),
            held,
            arrived,
            call,
            rpc,
            service: settings.shared.service.clone(),
            whole: Bytes::new(),
        };
        let span = record.span().clone();
        let slow_calls = settings.shared.slow_calls.clone();
        let answer = admitted.run(request, turns, record, resources, slow_calls);
        Box::pin(answer.instrument(span))
    }
}

impl CallsLayer {
    /// The name of the face in metrics.
    fn face(&self) -> &'static str {
        match self.callers {
            Callers::Clients => "grpc",
            Callers::Members => "cluster",
        }
    }

    /// The context of a call, without a deadline.
    fn context(&self, headers: &HeaderMap, activity: Option<&Activity>, flow: &Flow) -> Call {
        let peer = activity.and_then(Activity::peer);
        let is_forwarded = self.callers == Callers::Members;
        Call {
            caller: self.caller(headers, activity),
            peer: peer.map(Peer::Address),
            trace: traceparent(headers).map(Arc::from),
            is_forwarded,
            forwarded_client: forwarded(headers, CLIENT).filter(|_| is_forwarded),
            forwarded_uid: forwarded(headers, UID).filter(|_| is_forwarded),
            permits: Some(flow.permits()),
            ..Call::default()
        }
    }

    /// Gives a call its deadline and its bytes, or refuses it. Returns the place of a stream that lasts.
    fn admit(
        &self,
        rpc: Rpc,
        request: &Request<Body>,
        arrived: Instant,
        held: &HeldBytes,
        call: &mut Call,
    ) -> Result<Option<OwnedSemaphorePermit>, Status> {
        // The service checks the caller too; here a stranger is refused before it sends its request.
        check_caller(call)?;
        let deadline = deadline::read(request.headers(), arrived);
        call.deadline = deadline.map_err(|problem| refusals::malformed_timeout(&problem))?;
        let time = call.deadline.map(|deadline| deadline - arrived);
        held.flow().note_time(time);
        let activity = request.extensions().get::<Activity>();
        let stream = activity.filter(|_| rpc.lasts).map(Activity::stream);
        if matches!(stream, Some(None)) {
            self.shared.admission.count_excess();
            return Err(refusals::too_many_streams(self.max_calls).into());
        }
        if !held.take(call_bytes(request.uri(), request.headers())) {
            return Err(status::too_many_bytes(held.flow().max_bytes()).into());
        }
        if call.deadline.is_none() && rpc.is_unary() {
            call.has_default_deadline = true;
            call.deadline = arrived.checked_add(self.default_timeout);
        }
        Ok(stream.flatten())
    }

    /// The limits of the request of a call.
    fn requests(&self, rpc: Rpc) -> RequestLimits {
        let mut limits = self.requests;
        if rpc.is_of_indices() {
            limits.message = limits.message.for_indices();
        }
        limits.may_pause = rpc.streams_requests && rpc.lasts;
        limits
    }

    fn caller(&self, headers: &HeaderMap, activity: Option<&Activity>) -> Caller {
        let identities = &self.shared.identities;
        match self.callers {
            Callers::Clients => {
                identities.caller(token(headers), activity.and_then(Activity::certificate))
            }
            Callers::Members => {
                let name = headers.get(IDENTITY).map(|name| name.as_bytes());
                identities.forwarded(name.map(String::from_utf8_lossy).as_deref())
            }
        }
    }

    /// The flow of a call: that of its connection, or that of the connection's short calls of administration, which other load
    /// does not close.
    fn flow(&self, is_of_admin: bool, activity: Option<&Activity>) -> Arc<Flow> {
        let flow =
            activity.map_or_else(|| self.shared.admission.open(), |it| Arc::clone(it.flow()));
        match is_of_admin {
            true => Arc::clone(flow.admin()),
            false => flow,
        }
    }
}

#[cfg(test)]
mod tests;
