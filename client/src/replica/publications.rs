//! The mutations of an index as they are published over Zenoh, brought into the form of a watch: in order, without a gap
//! and without repeating one.
//!
//! A publication may be lost, and the next one shows it; what is missing is asked for from the index's log. Where nothing
//! is published for a while the log is asked too: the last publication may be what was lost, or the way there.

use std::{cmp::Ordering, sync::Arc, time::Duration};

use futures_util::stream;
use prost::Message;
use tokio::time::timeout;
use wayfold_proto::v1;
use zenoh::{
    Session,
    bytes::Encoding,
    handlers::{RingChannel, RingChannelHandler},
    pubsub::Subscriber,
    sample::Sample,
};

use crate::{Code, Error, IndexHandle, Refusal, Watch};

const CALL: &str = "replica";

/// So many publications wait to be taken; with one more the oldest is lost, and the log is asked for it.
const WAITING: usize = 256;

/// Where to follow: a session, and what the keys begin with.
#[derive(Clone, Debug)]
pub(super) struct Publications {
    session: Session,
    prefix: Arc<str>,
}

impl Publications {
    pub(super) fn new(session: Session, prefix: &str) -> Publications {
        Publications {
            session,
            prefix: prefix.into(),
        }
    }

    /// Follows an index from a revision on. `quiet`: how long nothing is published before the log is asked.
    pub(super) async fn watch(
        &self,
        index: &IndexHandle,
        after: u64,
        quiet: Duration,
    ) -> Result<Watch, Error> {
        let key = format!("{}/{}", self.prefix, index.name());
        // Before the log is asked for the first time: what is published meanwhile is not missed.
        let events = self.session.declare_subscriber(format!("{key}/events"));
        let events = events.with(RingChannel::new(WAITING)).await;
        let feed = Feed {
            session: self.session.clone(),
            events: events.map_err(|error| lost(&key, error))?,
            key,
            index: index.clone(),
            quiet,
            after,
            piece: 0,
            is_behind: true,
        };
        let messages = stream::try_unfold(feed, async |mut feed| {
            let message = feed.next().await?;
            Ok(Some((message, feed)))
        });
        Watch::of(index.watch().after(after), Box::pin(messages)).await
    }
}

/// One index that is followed.
struct Feed {
    session: Session,
    events: Subscriber<RingChannelHandler<Sample>>,
    /// What the index's keys begin with.
    key: String,
    index: IndexHandle,
    quiet: Duration,
    /// The newest revision that was told whole.
    after: u64,
    /// The piece of the next one that comes next.
    piece: u32,
    /// Something is missing that the log has.
    is_behind: bool,
}

impl Feed {
    async fn next(&mut self) -> Result<v1::WatchResponse, Error> {
        if self.is_behind {
            return self.ask().await;
        }
        match timeout(self.quiet, self.events.recv_async()).await {
            Ok(Ok(sample)) => self.take(&sample).await,
            Ok(Err(error)) => Err(lost(&self.key, error)),
            Err(_quiet) => self.ask().await,
        }
    }

    /// What is new in a publication.
    async fn take(&mut self, sample: &Sample) -> Result<v1::WatchResponse, Error> {
        let mut told = decode::<v1::WatchResponse>(&sample.payload().to_bytes())?;
        // Of what this means for the revisions that are known here the log tells.
        if told.uid != self.index.uid() || told.reset() != v1::ResetReason::Unspecified {
            return self.ask().await;
        }
        // The first, when somebody begins to follow, only says how far the index is.
        self.is_behind = told.mutations.is_empty() && told.revision > self.after;
        told.mutations.retain(|mutation| self.is_next(mutation));
        Ok(told)
    }

    /// Whether a mutation, or a piece of one, comes next; takes note if it does, and if something before it is missing.
    fn is_next(&mut self, mutation: &v1::Mutation) -> bool {
        let next = (self.after + 1, self.piece);
        match (mutation.revision, mutation.piece).cmp(&next) {
            Ordering::Less => false,
            Ordering::Equal => {
                (self.after, self.piece) = match mutation.continued {
                    true => (self.after, self.piece + 1),
                    false => (mutation.revision, 0),
                };
                true
            }
            Ordering::Greater => {
                self.is_behind = true;
                false
            }
        }
    }

    /// Asks the log for what comes next, whole.
    async fn ask(&mut self) -> Result<v1::WatchResponse, Error> {
        self.piece = 0;
        let told = match self.log().await {
            // A mutation that no answer holds: all points are read anew.
            Err(Error::Refused(refusal)) if is_too_large(&refusal) => v1::WatchResponse {
                uid: self.index.uid().to_owned(),
                revision: self.after,
                reset: v1::ResetReason::WindowPassed.into(),
                ..Default::default()
            },
            told => told?,
        };
        if let Some(last) = told.mutations.last() {
            self.after = last.revision;
        }
        self.is_behind = told.revision > self.after;
        Ok(told)
    }

    async fn log(&self) -> Result<v1::WatchResponse, Error> {
        let request = v1::WatchRequest {
            uid: self.index.uid().to_owned(),
            ..Default::default()
        };
        let asked = self
            .session
            .get(format!("{}/log?from={}", self.key, self.after))
            .payload(request.encode_to_vec())
            .encoding(Encoding::APPLICATION_PROTOBUF)
            .timeout(self.index.timeout());
        let replies = asked.await.map_err(|error| lost(&self.key, error))?;
        let reply = replies.recv_async().await;
        let reply = reply.map_err(|_| lost(&self.key, "nobody answers for its log"))?;
        match reply.into_result() {
            Ok(sample) => decode(&sample.payload().to_bytes()),
            Err(refused) if *refused.encoding() == Encoding::APPLICATION_PROTOBUF => {
                let status = decode(&refused.payload().to_bytes())?;
                Err(Error::Refused(Box::new(Refusal::from_message(&status))))
            }
            // What Zenoh itself says.
            Err(failed) => {
                let said = failed.payload().to_bytes();
                Err(lost(&self.key, String::from_utf8_lossy(&said)))
            }
        }
    }
}

fn is_too_large(refusal: &Refusal) -> bool {
    let limit = refusal.metadata.get("limit").map(String::as_str);
    refusal.code == Code::ResourceExhausted && limit == Some("answer_bytes")
}

fn lost(key: &str, why: impl ToString) -> Error {
    Error::Connection {
        call: CALL,
        uri: format!("Zenoh, {key}"),
        source: why.to_string().into(),
    }
}

fn decode<M: Message + Default>(payload: &[u8]) -> Result<M, Error> {
    M::decode(payload).map_err(|error| Error::Protocol {
        call: CALL,
        problem: format!("over Zenoh: {error}"),
    })
}
