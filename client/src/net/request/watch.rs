//! Following the mutations of an index.

mod event;
mod feed;

use std::{
    collections::VecDeque,
    fmt,
    sync::Arc,
    time::{Duration, SystemTime},
};

use futures_util::{StreamExt, future::BoxFuture, stream::BoxStream};
use tokio::time::{Instant, sleep_until, timeout};
use wayfold_proto::v1;

pub use event::{Mutation, Reset, ResetReason, WatchEvent};

use super::{awaitable, into_stream};
use crate::{Error, Include, IndexHandle, Points, Revision, net::connections::Connection};

/// Follows an index: every mutation, in order, once readers can see it; await it to begin.
///
/// ```no_run
/// use wayfold::{Client, WatchEvent};
///
/// # async fn example() -> Result<(), Box<dyn std::error::Error>> {
/// let client = Client::connect("http://127.0.0.1:50051").await?;
/// let index = client.index("arm").await?;
/// let mut watch = index.watch().after(index.revision_at(0)).await?;
/// while let Some(event) = watch.next().await? {
///     match event {
///         WatchEvent::Mutation(mutation) => println!(
///             "revision {}: {} stored, {} removed",
///             mutation.revision, mutation.stored.len(), mutation.removed_ids.len(),
///         ),
///         // The server cannot send the next mutations: read all points again, and watch from there.
///         WatchEvent::Reset(reset) => println!("the index is at revision {}", reset.revision),
///     }
/// }
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug)]
#[must_use = "a request does nothing until it is awaited"]
pub struct WatchRequest {
    index: IndexHandle,
    after: Option<Revision>,
    include: Include,
    own_session: u64,
    /// True if the watch goes on by itself where its server has gone.
    goes_on: bool,
}

/// A watch under way, a stream of events, which ends after a reset and after an error. If its server ends or falls
/// silent, it goes on at another one of the client's servers, or at the same one once that is back, with neither a gap
/// nor a repetition. It ends with an error once none has served it for the handle's timeout, and the last try may take as
/// long again; at once where the client [never retries](crate::RetryPolicy::never).
///
/// The server sends no faster than the caller takes the events. It sends a reset to a caller that is so slow that the
/// server no longer keeps the next mutations.
pub struct Watch {
    start: WatchStart,
    messages: Messages,
    /// Received, and not yet taken.
    ready: VecDeque<WatchEvent>,
    /// The first pieces of a mutation, and the number of the next piece.
    unfinished: Option<(Mutation, u32)>,
    /// The number of the newest revision that came whole.
    after: u64,
    newest: Revision,
    over: bool,
    /// The request that goes on where the server has gone; `None` if the caller does that.
    request: Option<WatchRequest>,
    /// The watch that goes on, while it begins.
    next: Option<BoxFuture<'static, Result<Watch, Error>>>,
    /// The time since which no server has served the watch, and the failures since.
    failing: Option<(Instant, u32)>,
    began: Instant,
}

/// The settings of a watch before its first message.
pub(crate) struct WatchStart {
    /// The server, as errors name it.
    pub(crate) server: String,
    /// The uid of the index.
    pub(crate) uid: Arc<str>,
    /// The number of coordinates of a state.
    pub(crate) coordinates: usize,
    /// The columns of stored points.
    pub(crate) include: Include,
    /// The number of the newest revision that the caller has; `None` for the newest of all.
    pub(crate) after: Option<u64>,
    /// The longest time until the first message.
    pub(crate) timeout: Duration,
}

/// The messages of a watch, in order and without a gap.
pub(crate) type Messages = BoxStream<'static, Result<v1::WatchResponse, Error>>;

awaitable!(WatchRequest => Watch);
into_stream!(Watch => WatchEvent);

const CALL: &str = "watch";

/// A watch that has stood for this long was served: a server that is cut off from its journal ends one after a second.
const RECOVERY_TIME: Duration = Duration::from_secs(3);

impl WatchRequest {
    pub(crate) fn new(index: IndexHandle) -> WatchRequest {
        WatchRequest {
            index,
            after: None,
            include: Include::points(),
            own_session: 0,
            goes_on: true,
        }
    }

    /// The watch of a shared index, which watches again by itself after an error. Mutations of this writer session come
    /// without points and removed ids: the caller knows them.
    pub(crate) fn for_copy(mut self, own_session: u64) -> WatchRequest {
        (self.own_session, self.goes_on) = (own_session, false);
        self
    }

    /// The mutations after this revision; those after the newest one unless set.
    pub fn after(mut self, revision: Revision) -> WatchRequest {
        self.after = Some(revision);
        self
    }

    /// The columns of stored points in addition to ids; states, tags and revisions unless set.
    pub fn include(mut self, include: Include) -> WatchRequest {
        self.include = include;
        self
    }

    async fn send(self) -> Result<Watch, Error> {
        let index = &self.index;
        let (client, waited) = (index.client(), index.timeout());
        let attempt = |connection: Connection, _remaining: Duration| {
            let (mut stub, message) = (connection.points(), self.message());
            let opening = async move {
                // Without a deadline, which would bound the whole stream.
                let mut messages = stub.watch(message).await?.into_inner();
                let first = messages.message().await?;
                Ok(tonic::Response::new((first, messages)))
            };
            client.connections().patiently(waited, opening)
        };
        let answer = client.call_at(CALL, waited, Instant::now() + waited, attempt);
        let ((first, messages), connection) = answer.await?;
        let start = WatchStart {
            server: connection.uri().to_string(),
            uid: index.revision().uid,
            coordinates: index.coordinates(),
            include: self.include,
            after: self.after.as_ref().map(|after| after.number),
            timeout: waited,
        };
        let messages = feed::messages(index.clone(), connection, first, messages);
        let watch = Watch::of(start, messages).await?;
        let goes_on = self.goes_on && client.retry_policy().attempts > 1;
        Ok(Watch {
            request: goes_on.then_some(self),
            ..watch
        })
    }

    fn message(&self) -> v1::WatchRequest {
        v1::WatchRequest {
            index_name: self.index.name().to_owned(),
            after_revision: self.after.as_ref().map(Revision::to_message),
            include: self.include.to_message(),
            own_session: self.own_session,
        }
    }
}

impl Watch {
    /// A watch of the messages of a server. The first comes at once, also where nothing is mutated.
    pub(crate) async fn of(start: WatchStart, messages: Messages) -> Result<Watch, Error> {
        let waited = start.timeout;
        let mut watch = Watch {
            messages,
            ready: VecDeque::new(),
            unfinished: None,
            after: 0,
            newest: Revision::new(Arc::clone(&start.uid), start.after.unwrap_or(0)),
            over: false,
            request: None,
            next: None,
            failing: None,
            began: Instant::now(),
            start,
        };
        let first = timeout(waited, watch.messages.next()).await;
        let first = first.map_err(|_| Error::timeout(CALL, waited))?;
        let mut first =
            first.ok_or_else(|| Error::protocol(CALL, "a watch without any message"))??;
        let begins_at = first.revision.as_ref().map(|revision| revision.number);
        let uid = first.revision.as_ref().map(|revision| &*revision.uid);
        if watch.start.after.is_none() && uid != Some(&*watch.start.uid) {
            // The request named no uid, so the server cannot know that the caller has another.
            first.reset = Some(v1::ResetReason::UidChanged.into());
        }
        watch.after = watch.start.after.or(begins_at).unwrap_or(0);
        watch.take_message(first)?;
        Ok(watch)
    }

    /// The newest readable revision. The caller lags behind it by its distance from the last mutation.
    pub fn newest(&self) -> &Revision {
        &self.newest
    }

    /// Waits for the next event, without a timeout; `None` at the end. A future that is dropped while it waits loses
    /// nothing.
    ///
    /// # Errors
    /// Those of every call; the watch is then over. `NOT_FOUND`: the index was deleted.
    pub async fn next(&mut self) -> Result<Option<WatchEvent>, Error> {
        loop {
            if let Some(event) = self.ready.pop_front() {
                return Ok(Some(event));
            }
            if self.over {
                return Ok(None);
            }
            if let Err(error) = self.receive().await {
                self.over = true;
                return Err(error);
            }
        }
    }

    /// Waits for a message, or for the watch that goes on.
    async fn receive(&mut self) -> Result<(), Error> {
        if let Some(next) = &mut self.next {
            let next = next.await;
            self.next = None;
            return match next {
                Ok(watch) => {
                    let newest = self.newest.clone();
                    *self = Watch {
                        failing: self.failing,
                        request: self.request.take(),
                        ..watch
                    };
                    self.note_newest(newest);
                    Ok(())
                }
                Err(error) => self.go_on_after(error),
            };
        }
        let error = match self.messages.next().await {
            Some(Ok(message)) => return self.take_message(message),
            Some(Err(error)) => error,
            // Only a reset ends a watch.
            None => Error::Connection {
                call: CALL,
                uri: self.start.server.clone(),
                source: "the server ended the stream".into(),
            },
        };
        if self.began.elapsed() >= RECOVERY_TIME {
            self.failing = None;
        }
        self.go_on_after(error)
    }

    /// Begins a watch after the newest mutation, or returns the error if it is final.
    fn go_on_after(&mut self, error: Error) -> Result<(), Error> {
        let Some(request) = &self.request else {
            return Err(error);
        };
        let (since, failures) = self.failing.unwrap_or((Instant::now(), 0));
        let index = &request.index;
        if !error.is_transient() || since.elapsed() >= index.timeout() {
            return Err(error);
        }
        if !feed::has_moved(&error) {
            self.failing = Some((since, failures + 1));
        }
        // A server that ends every watch at once is not asked all the time.
        let pause = match failures {
            0 => Duration::ZERO,
            more => (index.client().retry_policy()).endless_pause(more, Some(&error)),
        };
        let pause = pause.min(index.timeout());
        let request = request.clone().after(index.revision_at(self.after));
        self.next = Some(Box::pin(async move {
            sleep_until(Instant::now() + pause).await;
            request.send().await
        }));
        Ok(())
    }

    /// Another server may lag behind the one before.
    fn note_newest(&mut self, revision: Revision) {
        if revision.number > self.newest.number {
            self.newest = revision;
        }
    }

    /// The next event, if it has come.
    pub(crate) fn ready(&mut self) -> Option<WatchEvent> {
        self.ready.pop_front()
    }

    /// Takes the events of a message.
    fn take_message(&mut self, message: v1::WatchResponse) -> Result<(), Error> {
        let revision = Revision::from_message(CALL, message.revision, &self.start.uid)?;
        let reason = message.reset.map(|reason| match reason {
            1 => ResetReason::UidChanged,
            2 => ResetReason::WindowPassed,
            other => ResetReason::Other(other),
        });
        if let Some(reason) = reason {
            self.over = true;
            // The rest of the mutation cannot arrive.
            self.unfinished = None;
            let reset = Reset { reason, revision };
            self.ready.push_back(WatchEvent::Reset(reset));
            return Ok(());
        }
        if revision.uid != self.start.uid {
            return Err(Error::protocol(CALL, "mutations of another uid"));
        }
        self.note_newest(revision);
        for piece in message.mutations {
            self.take_piece(piece)?;
        }
        Ok(())
    }

    fn take_piece(&mut self, message: v1::Mutation) -> Result<(), Error> {
        let revision = Revision::from_message(CALL, message.revision, &self.start.uid)?;
        // No revision follows the greatest number.
        let expected = self.after.checked_add(1);
        if revision.uid != self.start.uid || Some(revision.number) != expected {
            let after = Revision::new(Arc::clone(&self.start.uid), self.after);
            let problem = format!("revision {revision} after {after}");
            return Err(Error::protocol(CALL, problem));
        }
        let WatchStart {
            coordinates,
            include,
            ..
        } = self.start;
        let stored =
            Points::from_message(CALL, message.stored, revision.clone(), coordinates, include)?;
        let mutation = match (self.unfinished.take(), message.piece) {
            // Also where a mutation begins again after its first pieces.
            (_, 0) => Mutation {
                revision: revision.clone(),
                time: SystemTime::UNIX_EPOCH + Duration::from_millis(message.time_ms),
                stored,
                removed_ids: message.removed_ids,
                session: message.session,
                batch: message.batch,
            },
            (Some((mut mutation, next)), piece) if next == piece => {
                mutation.stored.append(stored);
                mutation.removed_ids.extend(message.removed_ids);
                mutation
            }
            (_, piece) => {
                let problem = format!("piece {piece} of revision {revision} without those before");
                return Err(Error::protocol(CALL, problem));
            }
        };
        if message.continued {
            let next = message.piece.checked_add(1);
            let next = next.ok_or_else(|| Error::protocol(CALL, "a mutation without an end"))?;
            self.unfinished = Some((mutation, next));
        } else {
            (self.after, self.failing) = (revision.number, None);
            self.ready
                .push_back(WatchEvent::Mutation(Box::new(mutation)));
        }
        Ok(())
    }
}

impl fmt::Debug for Watch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Watch")
            .field("uid", &self.start.uid)
            .field("after", &self.after)
            .field("newest", &self.newest)
            .finish_non_exhaustive()
    }
}
