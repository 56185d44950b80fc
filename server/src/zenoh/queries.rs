//! Queries as they arrive: bounded, each answered once, refused with a reason where it can not be.

use std::{panic::AssertUnwindSafe, sync::Arc, time::Instant};

use futures_util::FutureExt;
use tokio::{runtime::Handle, sync::OwnedSemaphorePermit};
use tokio_util::{sync::CancellationToken, task::TaskTracker};
use tonic::{Code, Status};
use tracing::Instrument;
use zenoh::{
    key_expr::{KeyExpr, keyexpr},
    query::Query,
};

use super::{
    answer::{refuse, reply},
    asked::Asked,
    codec::Form,
    perform::perform,
    verb::Target,
    wild,
};
use crate::{
    capacity::Capacity,
    observe::CallRecord,
    service::{Error, Service, Unavailability},
    status,
};

const MAX_CALLS: &str = "zenoh.max_calls";
const MAX_MESSAGE_BYTES: &str = "zenoh.max_message_bytes";

/// Answers to one query, each under a key of its own.
pub(super) type Replies = Vec<(KeyExpr<'static>, Vec<u8>)>;

/// What answers queries.
pub(super) struct Queries {
    pub(super) service: Service,
    pub(super) prefix: String,
    pub(super) capacity: Capacity,
    pub(super) max_message_bytes: usize,
    /// Set once the server stops: from then on every query is refused, and takes no place.
    pub(super) stopping: CancellationToken,
    /// Where queries are answered. Zenoh's own threads serve all links, and must not be kept.
    pub(super) runtime: Handle,
    /// The queries under way.
    pub(super) under_way: TaskTracker,
}

impl Queries {
    /// Takes a query, or refuses it. Called on Zenoh's threads: a caller that asks more than it may is slowed down by the
    /// refusals that it has to take.
    pub(super) fn take(self: &Arc<Self>, query: Query) {
        let arrived = Instant::now();
        let form = Form::of(query.encoding()).unwrap_or(Form::Json);
        if self.stopping.is_cancelled() {
            let why = Unavailability::Stopping;
            return refuse(
                &query,
                form,
                &status::from_error(&Error::Unavailable { why }),
            );
        }
        match self.capacity.take() {
            Some(place) => {
                let answered = Arc::clone(self).answer(query, place, arrived);
                self.under_way.spawn_on(answered, &self.runtime);
            }
            None => refuse(&query, form, &self.busy()),
        }
    }

    async fn answer(self: Arc<Self>, query: Query, place: OwnedSemaphorePermit, arrived: Instant) {
        let target = Target::of(&self.prefix, query.key_expr());
        let rpc = match &target {
            Ok(target) => target.verb.name(),
            Err(_) => "other",
        };
        let mut record = CallRecord::begin(&format!("Zenoh/{rpc}"), arrived);
        let span = record.span().clone();
        let asked = AssertUnwindSafe(self.ask(&query, target, arrived)).catch_unwind();
        let answer = match asked.instrument(span).await {
            Ok(answer) => answer,
            Err(_panic) => Err(status::from_error(&Error::Internal {
                what: format!("Zenoh/{rpc} panicked"),
            })),
        };
        record.end(answer.as_ref().err().map_or(Code::Ok, Status::code));
        let form = Form::of(query.encoding()).unwrap_or(Form::Json);
        let sending = move || {
            match answer {
                Ok(replies) => {
                    for (key, payload) in replies {
                        reply(&query, &key, form, payload);
                    }
                }
                Err(status) => refuse(&query, form, &status),
            }
            // The caller is told that there is no more before the place is free.
            drop(query);
            drop(place);
        };
        // A link that is full of answers would keep the thread, and with it the calls of others. It fails to come back
        // only if it panicked.
        let _ = tokio::task::spawn_blocking(sending).await;
    }

    async fn ask(
        &self,
        query: &Query,
        target: Result<Target<'_>, Error>,
        arrived: Instant,
    ) -> Result<Replies, Status> {
        let bytes = query.payload().map_or(0, |payload| payload.len());
        if bytes > self.max_message_bytes {
            return Err(self.too_large(bytes));
        }
        let told = self.told(query, target, arrived).await;
        told.map_err(|error| status::from_error(&error))
    }

    async fn told(
        &self,
        query: &Query,
        target: Result<Target<'_>, Error>,
        arrived: Instant,
    ) -> Result<Replies, Error> {
        let form = Form::of(query.encoding())?;
        let key: &keyexpr = query.key_expr();
        let index = target.as_ref().map_or("", |target| target.index);
        let (asked, call) = Asked::of(query, form, index, arrived)?;
        let answered = async {
            if key.is_wild() {
                return wild::answer(&self.service, &call, &self.prefix, key, form).await;
            }
            let verb = target?.verb;
            asked.check(verb)?;
            let payload = perform(&self.service, &call, verb, &asked).await?;
            Ok(vec![(query.key_expr().clone().into_owned(), payload)])
        };
        let Some(deadline) = call.deadline else {
            return answered.await;
        };
        let answered = tokio::time::timeout_at(deadline.into(), answered).await;
        answered.unwrap_or(Err(Error::DeadlineExceeded {
            doing: "before the call was done",
        }))
    }

    fn busy(&self) -> Status {
        let limit = self.capacity.limit();
        status::limit(
            "TOO_MANY_CALLS",
            format!("as many calls are under way as {MAX_CALLS} = {limit} allows: try again later"),
            MAX_CALLS,
            limit,
        )
    }

    fn too_large(&self, bytes: usize) -> Status {
        let limit = self.max_message_bytes;
        status::limit(
            "LIMIT_EXCEEDED",
            format!(
                "the payload of {bytes} bytes exceeds the limit {MAX_MESSAGE_BYTES} = {limit}: split it into several \
                 queries"
            ),
            MAX_MESSAGE_BYTES,
            limit,
        )
    }
}
