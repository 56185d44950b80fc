//! The layer around every call: its span, deadline, share of the server's time and memory, and the record of its end.
//!
//! A request arrives whole before its call waits for a turn, unless it is a stream. Health and reflection take no turns:
//! they must answer just when the server is busy.

mod admitted;
mod open;

use std::{
    convert::Infallible,
    panic::AssertUnwindSafe,
    pin::{Pin, pin},
    sync::Arc,
    task::{Context, Poll},
    time::{Duration, Instant},
};

use bytes::Bytes;
use futures_util::{FutureExt, poll};
use http::{HeaderMap, Request, Response, Uri, header};
use tokio_util::task::TaskTracker;
use tonic::{Status, body::Body};
use tower::{Layer, Service};
use tracing::Instrument;

use admitted::Admitted;

use super::{
    body::{CallBody, CallResources},
    connections::Activity,
    deadline,
    refusals::{self, MessageLimit},
    request_body::RequestLimits,
    verbs::{
        has_stream_of_answers, has_stream_of_requests, is_lasting, is_of_indices, our_rpc, verb,
    },
};
use crate::{
    admission::{CALL_BYTES, Flow},
    config::GrpcConfig,
    faces::Shared,
    identity::{Caller, Denial, IdentificationError},
    observe::{self, CallRecord, Ending, Times},
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
pub(crate) fn open<R: observe::Request>(request: tonic::Request<R>) -> (Call, R) {
    let (call, message) = (call_of(&request), request.into_inner());
    observe::request(&message);
    (call, message)
}

/// The flow of a call, which the layer leaves there too.
pub(super) fn flow_of<T>(request: &tonic::Request<T>) -> Option<Arc<Flow>> {
    request.extensions().get::<Arc<Flow>>().cloned()
}

/// The header by which a member of the cluster names the identity of the caller whose call it forwards.
pub(super) const IDENTITY: &str = "wayfold-identity";

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
    shared: Shared,
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
        shared: Shared,
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
        let Some(rpc) = our_rpc(request.uri().path()) else {
            return match open::is_open(request.uri().path()) {
                true => Box::pin(open::answer(self.inner.clone(), request, &self.settings)),
                false => Box::pin(self.inner.call(request)),
            };
        };
        let activity = request.extensions().get::<Activity>().cloned();
        let active = match activity.as_ref().map(Activity::begin) {
            // The connection is being cut, and its calls with it.
            Some(None) => return Box::pin(std::future::pending()),
            begun => begun.flatten(),
        };
        let settings = &self.settings;
        let flow = settings.flow(rpc, activity.as_ref());
        // A call waits from its arrival on, not from the time that its task first runs.
        let mut turns = flow.turns();
        if turns.request().is_err() {
            // Under overload most calls end here: this must cost next to nothing.
            let mut refusal = Response::new(Body::empty());
            *refusal.headers_mut() = HeaderMap::clone(&settings.overloaded);
            return Box::pin(std::future::ready(Ok(refusal)));
        }
        // The clock starts here, not inside the future: after this function returns, tonic starts its own timer for the
        // same header and answers CANCELLED when it ends. Ours must never be the later one.
        let arrived = Instant::now();
        let peer = activity.as_ref().and_then(Activity::peer);
        let mut call = Call {
            caller: settings.caller(request.headers(), activity.as_ref()),
            peer: peer.map(Peer::Address),
            trace: traceparent(request.headers()).map(Arc::from),
            is_forwarded: settings.callers == Callers::Members,
            stored_reads: Some(flow.stored_reads()),
            ..Call::default()
        };
        let verb = (settings.face(), verb(rpc));
        let mut record = CallRecord::begin(rpc, verb, arrived, &settings.shared.metrics, &call);
        let held = Arc::new(flow.hold());
        let is_stream = has_stream_of_answers(rpc) || has_stream_of_requests(rpc);
        let lasting = activity.as_ref().filter(|_| is_lasting(rpc));
        let stream = lasting.map(Activity::stream);
        // The service checks the caller too; here a stranger is refused before it sends its request.
        let deadline = match (
            call.caller.check(),
            deadline::read(request.headers(), arrived),
        ) {
            (Err(why), _) => {
                let why = Denial::Unknown(why);
                Err(status::from_error(&Error::Denied { why }))
            }
            (Ok(()), Err(problem)) => Err(refusals::malformed_timeout(&problem)),
            _ if matches!(stream, Some(None)) => {
                settings.shared.admission.count_excess();
                Err(refusals::too_many_streams(settings.max_calls))
            }
            _ if !held.take(call_bytes(request.uri(), request.headers())) => {
                Err(status::too_many_bytes(flow.max_bytes()))
            }
            (_, Ok(None)) if !is_stream => {
                call.has_default_deadline = true;
                Ok(arrived.checked_add(settings.default_timeout))
            }
            (_, Ok(deadline)) => Ok(deadline),
        };
        match deadline {
            Ok(deadline) => call.deadline = deadline,
            Err(status) => {
                record.end(Ending::Failed(status.code));
                let refusal = Status::from(status).into_http();
                return Box::pin(std::future::ready(Ok(refusal)));
            }
        }
        let deadline = call.deadline;
        let resources = CallResources {
            activity,
            _active: active,
            _stream: stream.flatten(),
            _under_way: settings.under_way.token(),
            held: Arc::clone(&held),
        };
        let admitted = Admitted {
            inner: self.inner.clone(),
            limits: settings.requests(rpc),
            held,
            arrived,
            call,
            is_stream: has_stream_of_requests(rpc),
            service: settings.shared.service.clone(),
            whole: Bytes::new(),
        };
        let is_answer_stream = has_stream_of_answers(rpc);
        let span = record.span().clone();
        let slow_calls = settings.shared.slow_calls.clone();
        let answer = async move {
            let mut received = None;
            let answer = async {
                let mut receiving = pin!(admitted.receive(request));
                let arriving = match poll!(receiving.as_mut()) {
                    Poll::Ready(arrived) => arrived,
                    Poll::Pending => {
                        // The turn of a call whose request is on its way is another's.
                        turns.give_up();
                        receiving.await
                    }
                };
                let (admitted, request) = arriving?;
                received = Some(arrived.elapsed());
                let done = turns.run(admitted.answer(request)).await;
                done.unwrap_or_else(|overloaded| Err(status::overloaded(overloaded).into()))
            };
            let answer = AssertUnwindSafe(answer).catch_unwind();
            let answered = match deadline {
                Some(at) => tokio::time::timeout_at(at.into(), answer).await,
                None => Ok(answer.await),
            };
            let answered = match answered {
                Ok(Ok(answered)) => answered,
                Ok(Err(_panic)) => Err(refusals::panicked(record.rpc()).into()),
                Err(_) => Err(refusals::deadline_exceeded().into()),
            };
            if !is_stream {
                let answered = arrived.elapsed();
                let (queued, computed) = turns.times();
                let times = Times {
                    received: received.unwrap_or(answered),
                    queued,
                    computed,
                    answered,
                };
                record.took(times, &slow_calls);
            }
            let (response, made) =
                answered.unwrap_or_else(|status: Status| (status.into_http(), None));
            Ok(CallBody::wrap(
                response,
                made,
                record,
                resources,
                deadline,
                is_answer_stream.then_some(turns),
            ))
        };
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

    /// The limits of the request of a call.
    fn requests(&self, rpc: &str) -> RequestLimits {
        let mut limits = self.requests;
        if is_of_indices(rpc) {
            limits.message = limits.message.for_indices();
        }
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
    fn flow(&self, rpc: &str, activity: Option<&Activity>) -> Arc<Flow> {
        let is_admin =
            is_of_indices(rpc) && !has_stream_of_answers(rpc) && !has_stream_of_requests(rpc);
        let flow =
            activity.map_or_else(|| self.shared.admission.open(), |it| Arc::clone(it.flow()));
        match is_admin {
            true => Arc::clone(flow.admin()),
            false => flow,
        }
    }
}

#[cfg(test)]
mod tests;
