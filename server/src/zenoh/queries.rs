//! Arriving queries: their number is bounded, and each gets one answer or a refusal with its reason.

use std::{
    borrow::Cow,
    panic::AssertUnwindSafe,
    sync::Arc,
    time::{Duration, Instant},
};

use futures_util::FutureExt;
use tokio::{sync::Semaphore, task::block_in_place, time::timeout_at};
use tokio_util::{
    sync::CancellationToken,
    task::{TaskTracker, task_tracker::TaskTrackerToken},
};
use tracing::Instrument;
use zenoh::{
    bytes::ZBytes,
    key_expr::keyexpr,
    query::{Parameters, Query},
};

use super::{
    encoding,
    flows::Flows,
    inline::{self, Inline},
    response::{Replies, Response, reply_bytes},
    wildcard,
};
use crate::{
    admission::{CALL_BYTES, CallPlace, CallPlaces, CallTurns, HeldBytes, NoPlace},
    faces::{self, FaceContext},
    identity::{Caller, Denial, Identities},
    observe::{CallRecord, Ending, Times},
    service::{Call, Error, Peer, Unavailability},
    status::{self, Status},
    verbs::{Form, MAX_DYNAMIC_BYTES, MAX_TIMEOUT, Request, Target, Verb, dispatch, invalid},
};

/// The largest attachment: a token and the context of a trace.
const MAX_ATTACHMENT_BYTES: usize = 4 * 1024;

/// The largest selector, which has the parameters. Longer values belong in the payload.
const MAX_SELECTOR_BYTES: usize = 64 * 1024;

/// The advice to a query that has lost its place.
const LOST_PLACE: &str = "another link needs the place of this query: try again later";

/// Answers queries.
pub(super) struct Queries {
    pub(super) shared: FaceContext,
    pub(super) prefix: String,
    pub(super) flows: Flows,
    /// Bounds the queries in flight: each may wait for its link on a thread of its own.
    pub(super) places: Arc<CallPlaces>,
    /// Those of calls of administration.
    pub(super) admin_places: Arc<CallPlaces>,
    pub(super) max_calls: usize,
    /// Bounds the refusals that wait for their links, and the queries that lost their places.
    pub(super) refusals: Arc<Semaphore>,
    /// The deadline of queries that have none.
    pub(super) default_timeout: Duration,
    pub(super) max_message_bytes: usize,
    /// Set once the server stops: every later query is refused and takes no place.
    pub(super) stopping: CancellationToken,
    pub(super) inline: Arc<Inline>,
    /// The queries in progress.
    pub(super) under_way: TaskTracker,
}

/// An accepted query.
struct Accepted {
    query: Query,
    form: Result<Form, Error>,
    arrived: Instant,
    place: Arc<CallPlace>,
    held: Arc<HeldBytes>,
    turns: CallTurns,
    under_way: TaskTrackerToken,
}

impl Queries {
    /// Accepts or refuses a query, on a thread of Zenoh's.
    pub(super) fn take(self: &Arc<Self>, mut query: Query) {
        let arrived = Instant::now();
        let form = encoding::form(query.encoding());
        // Taken before the check for the stop: `stop` waits for every token.
        let under_way = self.under_way.token();
        if self.stopping.is_cancelled() {
            let why = Unavailability::Stopping;
            let status = status::from_error(&Error::Unavailable { why });
            return self.refuse(query, form, under_way, status);
        }
        let size = QuerySize::of(&query);
        if let Err(error) = size.check(matches!(form, Ok(Form::Json))) {
            return self.refuse(query, form, under_way, status::from_error(&error));
        }
        let target = Target::of(&self.prefix, query.key_expr().as_str());
        let verb = target.ok().map(|target| target.verb);
        let link = self.flows.of_reader();
        let (flow, places) = match verb {
            Some(verb) if verb.is_of_server() => (link.admin(), &self.admin_places),
            _ => (&link, &self.places),
        };
        let place = match places.take(flow, &self.refusals) {
            Ok(place) => place,
            Err(lack) => {
                let status = self.too_many_calls(match lack {
                    NoPlace::OfFlow => "wait for answers to this link, or try again later",
                    NoPlace::OfAll => "try again later",
                });
                return self.refuse(query, form, under_way, status);
            }
        };
        let held = Arc::new(flow.hold());
        let bytes = size.all();
        if !held.take(bytes.saturating_add(CALL_BYTES)) {
            let status = status::too_many_bytes(flow.max_bytes());
            return self.refuse(query, form, under_way, status);
        }
        let is_short = bytes <= inline::MAX_BYTES && verb.is_some_and(Verb::is_search);
        let mut turns = flow.turns();
        // A short search waits for its link, and must not have a turn meanwhile.
        if !is_short && let Err(late) = turns.request() {
            return self.refuse(query, form, under_way, status::overloaded(late));
        }
        if is_short && let Some(payload) = query.payload_mut() {
            // A copy of a few bytes: a slice would keep Zenoh's read buffer alive and make it allocate another.
            *payload = ZBytes::from(payload.to_bytes().into_owned());
        }
        let answering = Arc::clone(self).answer(Accepted {
            query,
            form,
            arrived,
            place,
            held,
            turns,
            under_way,
        });
        if is_short {
            self.inline.run(answering.boxed());
        } else {
            self.inline.run_elsewhere(answering.boxed());
        }
    }

    /// The refusal of a query without a place, which counts.
    fn too_many_calls(&self, advice: &str) -> Status {
        self.shared.admission.count_excess();
        status::too_many_calls("zenoh.max_calls", self.max_calls, advice)
    }

    /// Refuses a query that has no place.
    fn refuse(
        &self,
        mut query: Query,
        form: Result<Form, Error>,
        under_way: TaskTrackerToken,
        status: Status,
    ) {
        // Queries whose refusals no caller reads must not fill the memory. The query keeps its selector.
        let is_short = QuerySize::of(&query).selector <= MAX_SELECTOR_BYTES;
        if let Some(payload) = query.payload_mut() {
            *payload = ZBytes::new();
        }
        if let Some(attachment) = query.attachment_mut() {
            *attachment = ZBytes::new();
        }
        let refused = Response {
            query,
            form: form.unwrap_or(Form::Json),
            result: Err(status),
            place: None,
            held: None,
            under_way,
        };
        if is_short && let Ok(room) = Arc::clone(&self.refusals).try_acquire_owned() {
            self.inline.send(vec![Response {
                place: Some(room),
                ..refused
            }]);
        } else {
            // Blocks the link of a caller that does not read its refusals. Other links are read on another thread
            // meanwhile: Zenoh has 50 for this.
            block_in_place(|| refused.send());
        }
    }

    async fn answer(self: Arc<Self>, accepted: Accepted) -> Response {
        let Accepted {
            query,
            form,
            arrived,
            place,
            held,
            mut turns,
            under_way,
        } = accepted;
        let answer_in = *form.as_ref().unwrap_or(&Form::Json);
        let target = Target::of(&self.prefix, query.key_expr().as_str());
        let verb = target.as_ref().ok().map(|target| target.verb);
        let rpc = verb.map_or("other", Verb::name);
        // A wildcard reaches only what reads.
        let is_read = query.key_expr().is_wild()
            || verb.is_some_and(|verb| !verb.is_mutation() && !verb.is_of_server());
        let attached = attached(query.attachment());
        // It bounds the wait for a turn too. A wrong one is refused in the turn.
        let named = query.parameters().iter();
        let read = Request::of(answer_in, "", named, Cow::default(), arrived);
        let given = read.ok().and_then(|(_, deadline)| deadline);
        let deadline = given.unwrap_or(arrived + self.default_timeout.min(MAX_TIMEOUT));
        let call = Call {
            caller: caller(&self.shared.identities, &attached),
            peer: source(&query),
            trace: attached.get("traceparent").map(Arc::from),
            deadline: Some(deadline),
            has_default_deadline: given.is_none(),
            permits: Some(held.flow().permits()),
            held: Some(Arc::clone(&held)),
            // A mutation may take place although its query has ended.
            place: is_read.then(|| Arc::clone(&place)),
            ..Call::default()
        };
        let mut record = CallRecord::begin(
            format!("Zenoh/{rpc}"),
            "zenoh",
            rpc,
            arrived,
            &self.shared.metrics,
            &call,
        );
        let span = record.span().clone();
        let evaluation = async {
            let no_room = || status::too_many_bytes(held.flow().max_bytes());
            if !held.check_room(0) {
                return Err(no_room());
            }
            let replies = self.replies(&query, form, target, arrived, call).await;
            let replies = replies.map_err(|error| status::from_error(&error))?;
            // Only now their size is known. Those to a mutation, which took place, are always given.
            if is_read && !held.check_room(reply_bytes(&replies)) {
                return Err(no_room());
            }
            Ok(replies)
        };
        let answering = AssertUnwindSafe(turns.run(evaluation)).catch_unwind();
        let answering = timeout_at(deadline.into(), answering.instrument(span));
        // A short search must not pay for the second branch, so that is polled last.
        let answered = tokio::select! {
            biased;
            answered = answering => Some(answered),
            () = place.lost() => None,
        };
        let result = match answered {
            Some(Ok(Ok(Ok(answer)))) => answer,
            Some(Ok(Ok(Err(late)))) => Err(status::overloaded(late)),
            Some(Ok(Err(_panic))) => Err(faces::panicked(record.rpc())),
            Some(Err(_elapsed)) => Err(faces::deadline_exceeded()),
            None => Err(self.too_many_calls(LOST_PLACE)),
        };
        let (queued, computed) = turns.times();
        let times = Times {
            received: Duration::ZERO,
            queued,
            computed,
            answered: arrived.elapsed(),
        };
        record.took(times, &self.shared.slow_calls);
        record.end(match &result {
            Ok(_) => Ending::Ok,
            Err(status) => Ending::Failed(status.code),
        });
        let response = Response {
            query,
            form: answer_in,
            result,
            place: place.end(),
            held: None,
            under_way,
        };
        held.force_take(response.bytes());
        Response {
            held: Some(held),
            ..response
        }
    }

    async fn replies(
        &self,
        query: &Query,
        form: Result<Form, Error>,
        target: Result<Target<'_>, Error>,
        arrived: Instant,
        call: Call,
    ) -> Result<Replies, Error> {
        let bytes = query.payload().map_or(0, |payload| payload.len());
        if bytes > self.max_message_bytes {
            return Err(Error::LimitExceeded {
                limit: "zenoh.max_message_bytes",
                value: self.max_message_bytes as u64,
                requested: bytes as u64,
                advice: "split the payload over several queries",
            });
        }
        // The service checks the caller too; here a stranger is refused before its request is parsed.
        call.caller.check().map_err(|why| Error::Denied {
            why: Denial::Unknown(why),
        })?;
        let form = form?;
        let key: &keyexpr = query.key_expr();
        let index = target.as_ref().map_or("", |target| target.index);
        let payload = query.payload().map(ZBytes::to_bytes).unwrap_or_default();
        let named = query.parameters().iter();
        let (request, _) = Request::of(form, index, named, payload, arrived)?;
        if key.is_wild() {
            let replies = wildcard::answer(&self.shared.service, &call, &self.prefix, key, form);
            return Box::pin(replies).await;
        }
        let verb = target?.verb;
        request.check(verb)?;
        let limit = self.max_message_bytes;
        let payload = dispatch(&self.shared.service, &call, verb, &request, limit).await?;
        Ok(vec![(query.key_expr().clone().into_owned(), payload)])
    }
}

/// The bytes of the parts of a query.
struct QuerySize {
    payload: usize,
    selector: usize,
    attachment: usize,
}

impl QuerySize {
    fn of(query: &Query) -> Self {
        let parameters = query.parameters().as_str().len();
        // A `?` precedes the parameters.
        let parameters = parameters + usize::from(parameters > 0);
        Self {
            payload: query.payload().map_or(0, ZBytes::len),
            selector: query.key_expr().as_str().len() + parameters,
            attachment: query.attachment().map_or(0, ZBytes::len),
        }
    }

    fn all(&self) -> usize {
        self.payload + self.selector + self.attachment
    }

    /// Refuses a large selector or attachment, and a large payload in JSON. Other payloads have a setting.
    fn check(&self, is_json: bool) -> Result<(), Error> {
        if is_json && self.payload > MAX_DYNAMIC_BYTES {
            let text = format!(
                "it has {} bytes of JSON, more than {MAX_DYNAMIC_BYTES}: send Protocol Buffers, or fewer rows",
                self.payload
            );
            return Err(invalid("payload", "JSON_TOO_LONG", text));
        }
        if self.attachment > MAX_ATTACHMENT_BYTES {
            let text = format!(
                "it has {} bytes, more than {MAX_ATTACHMENT_BYTES}: send the token and the traceparent only",
                self.attachment
            );
            return Err(invalid("attachment", "ATTACHMENT_TOO_LONG", text));
        }
        if self.selector > MAX_SELECTOR_BYTES {
            let text = format!(
                "it has {} bytes, more than {MAX_SELECTOR_BYTES}: move parameters into the payload",
                self.selector
            );
            return Err(invalid("selector", "SELECTOR_TOO_LONG", text));
        }
        Ok(())
    }
}

/// The session that sent the query, if the query names it.
fn source(query: &Query) -> Option<Peer> {
    let source = query.source_info()?.source_id();
    Some(Peer::Session(u128::from_le_bytes(
        source.zid().to_le_bytes(),
    )))
}

/// The attachment of a query, `token=TOKEN;traceparent=…`. Any other text counts as empty.
pub(crate) fn attached(attachment: Option<&ZBytes>) -> Parameters<'static> {
    let bytes = attachment.map(ZBytes::to_bytes);
    let text = bytes.and_then(|bytes| String::from_utf8(bytes.into_owned()).ok());
    Parameters::from(text.unwrap_or_default())
}

/// The caller with the token of an attachment.
pub(crate) fn caller(identities: &Identities, attached: &Parameters<'_>) -> Caller {
    identities.caller(attached.get("token").map(str::as_bytes), None)
}
