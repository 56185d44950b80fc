//! Following the mutations of an index.

use std::{
    collections::VecDeque,
    fmt,
    time::{Duration, SystemTime},
};

use futures_util::{Stream, StreamExt, stream, stream::BoxStream};
use tokio::time::timeout;
use wayfold_proto::v1;

use super::awaitable;
use crate::{Error, IndexHandle, Points};

/// Follows an index: every mutation, in order, once readers can see it; await it to begin.
///
/// ```no_run
/// use wayfold::{Client, WatchEvent};
///
/// # async fn example() -> Result<(), Box<dyn std::error::Error>> {
/// let client = Client::connect("http://127.0.0.1:50051").await?;
/// let mut watch = client.index("arm").await?.watch().after(0).payloads().await?;
/// while let Some(event) = watch.next().await? {
///     match event {
///         WatchEvent::Mutation(mutation) => println!(
///             "revision {}: {} stored, {} removed",
///             mutation.revision, mutation.stored.len(), mutation.removed.len(),
///         ),
///         // The mutations that would follow cannot be told: read all points anew, and follow from there.
///         WatchEvent::Reset(reset) => println!("the index is at revision {} of {}", reset.revision, reset.uid),
///     }
/// }
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug)]
#[must_use = "a request does nothing until it is awaited"]
pub struct WatchRequest {
    index: IndexHandle,
    after: Option<u64>,
    payloads: bool,
}

/// A watch under way. It ends after a reset and after an error; to go on after an error, watch again from the newest
/// revision that came, with a handle of the same uid.
///
/// The server sends no faster than the events are taken. Who takes them too slowly, so that the server forgets what
/// comes next, is told a reset.
pub struct Watch {
    index: IndexHandle,
    payloads: bool,
    messages: Messages,
    /// What came and was not taken.
    ready: VecDeque<WatchEvent>,
    /// The beginning of a mutation of which the rest is to come, and which piece comes next.
    begun: Option<(Mutation, u32)>,
    /// The newest revision that came whole.
    after: u64,
    newest: u64,
    over: bool,
}

/// What a server tells who watches: each message after the one before, without a gap.
pub(crate) type Messages = BoxStream<'static, Result<v1::WatchResponse, Error>>;

/// What a watch tells.
#[derive(Clone, Debug, PartialEq)]
pub enum WatchEvent {
    /// The next mutation.
    Mutation(Mutation),
    /// What comes next cannot be told. The last event.
    Reset(Reset),
}

/// One mutation, whole: what it stored and what it removed. No id is in both.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Mutation {
    /// The revision that it made.
    pub revision: u64,
    /// When, by the server's clock.
    pub time: SystemTime,
    /// The points that it stored, each in the place of one with the same id. The revision of a point is that of its
    /// state: an older one than the mutation's if only the tag or the payload is new.
    pub stored: Points,
    /// The ids of the points that it removed.
    pub removed: Vec<u64>,
}

/// Why a watch cannot go on, and where the index stands.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Reset {
    /// Why.
    pub reason: ResetReason,
    /// The uid that the index has.
    pub uid: String,
    /// The newest revision, of that uid, that can be read.
    pub revision: u64,
}

/// Why a watch cannot go on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ResetReason {
    /// The index has another uid than the handle: it was deleted and created again, restored, or lost what was not
    /// synced. Go on with a new handle, [`Client::index`](crate::Client::index).
    UidChanged,
    /// The server does not keep the next mutations any more.
    WindowPassed,
    /// A reason that this client does not know.
    Other(i32),
}

awaitable!(WatchRequest => Watch);

const CALL: &str = "watch";

impl WatchRequest {
    pub(crate) fn new(index: IndexHandle) -> WatchRequest {
        WatchRequest {
            index,
            after: None,
            payloads: false,
        }
    }

    /// Only the mutations after this revision, of the handle's uid; those after the newest one unless set.
    pub fn after(mut self, revision: u64) -> WatchRequest {
        self.after = Some(revision);
        self
    }

    /// Reads the payloads of stored points too.
    pub fn payloads(mut self) -> WatchRequest {
        self.payloads = true;
        self
    }

    async fn send(self) -> Result<Watch, Error> {
        let (stub, client) = (self.index.client().points(), self.index.client());
        let attempt = |_remaining: Duration| {
            let (mut stub, message) = (stub.clone(), self.message());
            // Without a deadline, which would bound the whole stream.
            async move { stub.watch(message).await }
        };
        let waited = self.index.timeout();
        let messages = client.call(CALL, waited, attempt).await?;
        let uri = client.uri().to_owned();
        let messages = messages
            .map(move |told| told.map_err(|status| Error::from_status(CALL, &uri, waited, status)));
        Watch::of(self, Box::pin(messages)).await
    }

    fn message(&self) -> v1::WatchRequest {
        v1::WatchRequest {
            index: self.index.name().to_owned(),
            uid: self.index.uid().to_owned(),
            after_revision: self.after,
            payloads: self.payloads,
        }
    }
}

impl Watch {
    /// What is told by messages to a request, of which the first comes at once, also where nothing is mutated.
    pub(crate) async fn of(request: WatchRequest, messages: Messages) -> Result<Watch, Error> {
        let waited = request.index.timeout();
        let mut watch = Watch {
            messages,
            ready: VecDeque::new(),
            begun: None,
            after: 0,
            newest: 0,
            over: false,
            payloads: request.payloads,
            index: request.index,
        };
        let first = timeout(waited, watch.messages.next()).await;
        let first = first.map_err(|_| Error::timeout(CALL, waited))?;
        let first = first.ok_or_else(|| protocol("a watch without any message"))??;
        watch.after = request.after.unwrap_or(first.revision);
        watch.take(first)?;
        Ok(watch)
    }

    /// The newest revision that the server told of. How far the mutations are behind it is how far the caller is.
    pub fn newest(&self) -> u64 {
        self.newest
    }

    /// Waits for the next event, for as long as there is none; `None` at the end. If it is dropped while it waits,
    /// nothing is lost.
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
            let received = match self.messages.next().await {
                Some(Ok(message)) => self.take(message),
                // A watch has no end of its own but a reset.
                None => Err(Error::Connection {
                    call: CALL,
                    uri: self.index.client().uri().to_owned(),
                    source: "the server ended the stream".into(),
                }),
                Some(Err(error)) => Err(error),
            };
            if let Err(error) = received {
                self.over = true;
                return Err(error);
            }
        }
    }

    /// The next event, if it has come.
    #[cfg(feature = "replica")]
    pub(crate) fn ready(&mut self) -> Option<WatchEvent> {
        self.ready.pop_front()
    }

    /// The events from here on as a stream.
    pub fn into_stream(self) -> impl Stream<Item = Result<WatchEvent, Error>> + Send + 'static {
        stream::try_unfold(self, |mut watch| async move {
            Ok(watch.next().await?.map(|event| (event, watch)))
        })
    }

    /// Takes the events of a message.
    fn take(&mut self, message: v1::WatchResponse) -> Result<(), Error> {
        let reason = match message.reset {
            0 => None,
            1 => Some(ResetReason::UidChanged),
            2 => Some(ResetReason::WindowPassed),
            other => Some(ResetReason::Other(other)),
        };
        if let Some(reason) = reason {
            self.over = true;
            // What was begun is never told.
            self.begun = None;
            self.ready.push_back(WatchEvent::Reset(Reset {
                reason,
                uid: message.uid,
                revision: message.revision,
            }));
            return Ok(());
        }
        if message.uid != self.index.uid() {
            return Err(protocol("mutations of another uid"));
        }
        self.newest = message.revision;
        self.index.told(&message.uid, message.revision);
        for piece in message.mutations {
            self.take_piece(piece)?;
        }
        Ok(())
    }

    fn take_piece(&mut self, message: v1::Mutation) -> Result<(), Error> {
        let (revision, expected) = (message.revision, self.after + 1);
        if revision != expected {
            return Err(protocol(&format!(
                "revision {revision} where {expected} comes next"
            )));
        }
        let stored = Points::from_message(
            CALL,
            message.stored,
            revision,
            self.index.coordinates(),
            self.payloads,
        )?;
        let mutation = match (self.begun.take(), message.piece) {
            // Also where it was begun before, and begins anew.
            (_, 0) => Mutation {
                revision,
                time: SystemTime::UNIX_EPOCH + Duration::from_millis(message.time_ms),
                stored,
                removed: message.removed_ids,
            },
            (Some((mut begun, next)), piece) if next == piece => {
                begun.stored.append(stored);
                begun.removed.extend(message.removed_ids);
                begun
            }
            (_, piece) => {
                return Err(protocol(&format!(
                    "piece {piece} of revision {revision} without those before"
                )));
            }
        };
        if message.continued {
            self.begun = Some((mutation, message.piece + 1));
        } else {
            self.after = revision;
            self.ready.push_back(WatchEvent::Mutation(mutation));
        }
        Ok(())
    }
}

impl fmt::Debug for Watch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Watch")
            .field("index", &self.index)
            .field("after", &self.after)
            .field("newest", &self.newest)
            .finish_non_exhaustive()
    }
}

fn protocol(problem: &str) -> Error {
    Error::Protocol {
        call: CALL,
        problem: problem.to_owned(),
    }
}
