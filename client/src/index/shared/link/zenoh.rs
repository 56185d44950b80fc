//! The link over Zenoh: a query for each call.

use std::{ops::Deref, sync::Arc, time::Duration};

use futures_util::{StreamExt, stream};
use prost::Message;
use tokio::{
    sync::oneshot,
    time::{Instant, timeout_at},
};
use wayfold_proto::v1;
use zenoh::{
    Session,
    bytes::{Encoding, ZBytes},
    key_expr::KeyExpr,
    query::ConsolidationMode,
    sample::SourceInfo,
};

use super::{
    is_transient,
    load::{Part, Parts},
};
use crate::{
    Credentials, Error, Include, IndexInfo, Points, Refusal, RetryPolicy, Revision,
    index::runtime::spawn,
    net::call::{Call, Key},
};

/// A session, and the keys of an index.
#[derive(Clone, Debug)]
pub(super) struct ZenohLink {
    pub(super) session: Arc<HeldSession>,
    /// The prefix of all keys.
    prefix: Arc<str>,
    /// The prefix of the index's keys.
    index: Arc<str>,
    pub(super) timeout: Duration,
    credentials: Credentials,
}

/// A session whose last clone is dropped on the thread that talks to servers. That drop waits for the network, and
/// panics in a runtime of one thread.
#[derive(Debug)]
pub(super) struct HeldSession {
    session: Session,
    /// Dropped after `session`.
    _end: oneshot::Sender<()>,
}

impl HeldSession {
    fn new(session: Session) -> Result<HeldSession, Error> {
        let (end, ended) = oneshot::channel();
        let last = session.clone();
        spawn(async move {
            let _dropped = ended.await;
            drop(last);
        })?;
        Ok(HeldSession { session, _end: end })
    }
}

impl Deref for HeldSession {
    type Target = Session;

    fn deref(&self) -> &Session {
        &self.session
    }
}

impl ZenohLink {
    pub(super) fn new(
        session: Session,
        (prefix, name): (&str, &str),
        timeout: Duration,
        credentials: &Credentials,
    ) -> Result<ZenohLink, Error> {
        check_key("prefix", prefix)?;
        check_key("name", name)?;
        Ok(ZenohLink {
            session: Arc::new(HeldSession::new(session)?),
            prefix: prefix.into(),
            index: format!("{prefix}/{name}").into(),
            timeout,
            credentials: credentials.clone(),
        })
    }

    /// Makes a call, with retries.
    pub(super) async fn call<C: Call>(
        &self,
        request: &C,
        policy: RetryPolicy,
    ) -> Result<C::Answer, Error> {
        let key = match C::KEY {
            Key::Server(verb) => format!("{}/{verb}", self.prefix),
            Key::Index(verb) => self.key(verb),
        };
        self.ask(C::NAME, &key, request, policy).await
    }

    /// A key of the index.
    pub(super) fn key(&self, verb: &str) -> String {
        format!("{}/{verb}", self.index)
    }

    /// All points of an index at revision `min_revision` or a later one, page by page.
    pub(super) fn scan(&self, index: &IndexInfo, min_revision: u64) -> Parts {
        let request = v1::ScanRequest {
            include: Include::points().to_message(),
            min_revision: Some(index.revision_at(min_revision).to_message()),
            ..Default::default()
        };
        let pages = Pages {
            link: self.clone(),
            coordinates: index.coordinate_count,
            uid: Arc::clone(index.uid()),
            revision: None,
            next: Some(request),
        };
        let parts = stream::try_unfold(pages, async |mut pages| {
            let part = pages.next().await?;
            Ok(part.map(|part| (part, pages)))
        });
        parts.boxed()
    }

    async fn ask<Q: Message, A: Message + Default>(
        &self,
        call: &'static str,
        key: &str,
        request: &Q,
        policy: RetryPolicy,
    ) -> Result<A, Error> {
        let payload = ZBytes::from(request.encode_to_vec());
        let deadline = Instant::now() + self.timeout;
        let attempt = || self.attempt(call, key, payload.clone(), deadline);
        policy.run(deadline, attempt).await
    }

    /// Makes a call once, with an encoded request.
    pub(super) async fn attempt<A: Message + Default>(
        &self,
        call: &'static str,
        key: &str,
        request: ZBytes,
        deadline: Instant,
    ) -> Result<A, Error> {
        let remaining = deadline.saturating_duration_since(Instant::now());
        let selector = format!("{key}?timeout_ms={}", remaining.as_millis());
        let query = self.session.get(selector);
        let query = query.payload(request).timeout(remaining);
        let query = query.encoding(Encoding::APPLICATION_PROTOBUF);
        // The first answer counts. Without this it would come after the last one.
        let query = query.consolidation(ConsolidationMode::None);
        // The server's log names the session by it.
        let query = query.source_info(SourceInfo::new(self.session.id(), 0));
        let query = query.attachment(self.credentials.attachment().map(ZBytes::from));
        let replies = query.await.map_err(|error| lost(call, key, error))?;
        let mut failed = None;
        loop {
            let reply = match timeout_at(deadline, replies.recv_async()).await {
                Ok(Ok(reply)) => reply.into_result(),
                Ok(Err(_no_more)) => break,
                Err(_) => {
                    failed.get_or_insert_with(|| Error::timeout(call, self.timeout));
                    break;
                }
            };
            match reply {
                Ok(sample) => return decode(call, &sample.payload().to_bytes()),
                // Another server under the prefix may still take the call. A refusal that may end counts more than one
                // that is final.
                Err(refused) if *refused.encoding() == Encoding::APPLICATION_PROTOBUF => {
                    let status = decode(call, &refused.payload().to_bytes())?;
                    let refusal = Error::Refused(Box::new(Refusal::from_message(&status)));
                    failed = failed.filter(is_transient).or(Some(refusal));
                }
                // Zenoh itself gave up.
                Err(_) if Instant::now() >= deadline => {
                    failed.get_or_insert_with(|| Error::timeout(call, self.timeout));
                }
                Err(gave_up) => {
                    let text = gave_up.payload().to_bytes();
                    let text = String::from_utf8_lossy(&text);
                    failed.get_or_insert_with(|| lost(call, key, text));
                }
            }
        }
        Err(failed.unwrap_or_else(|| lost(call, key, "no server answers")))
    }
}

/// A scan by pages. The server holds their revision.
struct Pages {
    link: ZenohLink,
    coordinates: usize,
    uid: Arc<str>,
    /// The revision that is read, once the first page has named it.
    revision: Option<Revision>,
    /// The request for the next page; `None` after the last.
    next: Option<v1::ScanRequest>,
}

impl Pages {
    async fn next(&mut self) -> Result<Option<Part>, Error> {
        const CALL: &str = "scan";
        let Some(request) = self.next.take() else {
            return Ok(None);
        };
        let key = self.link.key("scan");
        let page = self.link.ask(CALL, &key, &request, RetryPolicy::default());
        let page: v1::ScanResponse = page.await?;
        let revision = Revision::from_message(CALL, page.revision, &self.uid)?;
        let points = Points::from_message(
            CALL,
            page.points,
            revision.clone(),
            self.coordinates,
            Include::points(),
        )?;
        let last = points.ids().last().copied();
        let is_other = self.revision.as_ref().is_some_and(|held| *held != revision);
        let is_last = page.held_scan.is_empty();
        // A page without points that is not the last would be followed by the same one.
        if is_other || !is_last && last <= request.after_id {
            let problem = format!("a page of revision {revision} that does not follow");
            return Err(Error::protocol(CALL, problem));
        }
        self.revision = Some(revision);
        if !is_last {
            self.next = Some(v1::ScanRequest {
                held_scan: page.held_scan,
                after_id: last,
                ..request
            });
        }
        let total = page.point_count;
        Ok(Some(Part { points, total }))
    }
}

/// Refuses a key that does not name one thing.
fn check_key(field: &'static str, key: &str) -> Result<(), Error> {
    let problem = match KeyExpr::try_from(key) {
        Ok(expression) if !expression.is_wild() => return Ok(()),
        Ok(_) => format!("{key:?} has a wildcard"),
        Err(error) => format!("{key:?} is no key of Zenoh: {error}"),
    };
    Err(Error::Argument { field, problem })
}

pub(super) fn lost(call: &'static str, key: &str, why: impl ToString) -> Error {
    Error::Connection {
        call,
        uri: format!("Zenoh, {key}"),
        source: why.to_string().into(),
    }
}

pub(super) fn decode<M: Message + Default>(call: &'static str, payload: &[u8]) -> Result<M, Error> {
    M::decode(payload).map_err(|error| Error::protocol(call, format!("over Zenoh: {error}")))
}
