//! The publications of an index over Zenoh in the form of a watch: in order, without a gap and without a repeat.
//!
//! A publication may be lost. The next one shows the gap, and the index's log fills it. After a
//! while without publications the feed reads the log too, because the last publication or the link to the server may be
//! lost.

use std::{cmp::Ordering, sync::Arc, time::Duration};

use futures_util::stream;
use prost::Message;
use tokio::time::{Instant, timeout};
use wayfold_proto::v1;
use zenoh::{
    handlers::{RingChannel, RingChannelHandler},
    pubsub::Subscriber,
    sample::Sample,
};

use super::zenoh::{ZenohLink, decode, lost};
use crate::{
    Error, Include, IndexInfo, Watch,
    net::{
        limits::{ANSWER_BYTES, exceeded},
        request::WatchStart,
    },
};

const CALL: &str = "watch";

/// The last part of the key of mutations without payloads.
const EVENTS: &str = "events/states";

/// The number of publications that may wait. One more drops the oldest, and the log fills the gap.
const MAX_WAITING: usize = 256;

/// The time without a publication after which the index's log is read: the last one may be lost.
const QUIET_TIME: Duration = Duration::from_secs(1);

/// Watches an index after a revision. Where the feed reads the log, it leaves out the points of `own_session`.
pub(super) async fn watch(
    link: ZenohLink,
    index: Arc<IndexInfo>,
    after: u64,
    own_session: u64,
) -> Result<Watch, Error> {
    let key = link.key(EVENTS);
    // The subscription precedes the first read of the log, so that no publication is missed.
    let events = link.session.declare_subscriber(&key);
    let events = events.with(RingChannel::new(MAX_WAITING)).await;
    let start = WatchStart {
        uid: Arc::clone(index.uid()),
        coordinates: index.coordinate_count,
        include: Include::points(),
        after: Some(after),
        timeout: link.timeout,
        server: format!("Zenoh, {key}"),
    };
    let feed = Feed {
        events: events.map_err(|error| lost(CALL, &key, error))?,
        link,
        index,
        own_session,
        after,
        piece: 0,
        is_behind: true,
    };
    let messages = stream::try_unfold(feed, async |mut feed| {
        let message = feed.next().await?;
        Ok(Some((message, feed)))
    });
    Watch::of(start, Box::pin(messages)).await
}

/// One index that is followed.
struct Feed {
    link: ZenohLink,
    events: Subscriber<RingChannelHandler<Sample>>,
    index: Arc<IndexInfo>,
    own_session: u64,
    /// The number of the newest revision that arrived whole.
    after: u64,
    /// The number of the next piece of the mutation after it.
    piece: u32,
    /// True if the log has mutations that did not arrive.
    is_behind: bool,
}

impl Feed {
    async fn next(&mut self) -> Result<v1::WatchResponse, Error> {
        if self.is_behind {
            return self.read_log().await;
        }
        match timeout(QUIET_TIME, self.events.recv_async()).await {
            Ok(Ok(sample)) => self.take(&sample).await,
            Ok(Err(error)) => Err(lost(CALL, &self.link.key(EVENTS), error)),
            Err(_quiet) => self.read_log().await,
        }
    }

    /// The event of a publication.
    async fn take(&mut self, sample: &Sample) -> Result<v1::WatchResponse, Error> {
        let mut message = decode::<v1::WatchResponse>(CALL, &sample.payload().to_bytes())?;
        let revision = message.revision.clone().unwrap_or_default();
        // The log decides whether the caller's revision is still valid.
        if *revision.uid != **self.index.uid() || message.reset.is_some() {
            return self.read_log().await;
        }
        // The first message after a subscription only names the newest revision.
        self.is_behind = message.mutations.is_empty() && revision.number > self.after;
        message.mutations.retain(|mutation| self.is_next(mutation));
        Ok(message)
    }

    /// True if `mutation`, or this piece of it, comes next, and then records it. Records a gap if a later one comes.
    fn is_next(&mut self, mutation: &v1::Mutation) -> bool {
        let next = (self.after.saturating_add(1), self.piece);
        let number = number(mutation.revision.as_ref());
        match (number, mutation.piece).cmp(&next) {
            Ordering::Less => false,
            Ordering::Equal => {
                (self.after, self.piece) = match mutation.continued {
                    true => (self.after, self.piece.saturating_add(1)),
                    false => (number, 0),
                };
                true
            }
            Ordering::Greater => {
                self.is_behind = true;
                false
            }
        }
    }

    /// Reads the next mutations from the log, whole.
    async fn read_log(&mut self) -> Result<v1::WatchResponse, Error> {
        self.piece = 0;
        let after = self.index.revision_at(self.after).to_message();
        let message = match self.log(after.clone()).await {
            // No answer holds the next mutation: all points have to be read again.
            Err(error) if exceeded(&error) == Some(ANSWER_BYTES) => v1::WatchResponse {
                revision: Some(after),
                reset: Some(v1::ResetReason::WindowPassed.into()),
                ..Default::default()
            },
            answer => answer?,
        };
        if let Some(last) = message.mutations.last() {
            self.after = number(last.revision.as_ref());
        }
        self.is_behind = number(message.revision.as_ref()) > self.after;
        Ok(message)
    }

    async fn log(&self, after: v1::Revision) -> Result<v1::WatchResponse, Error> {
        let request = v1::WatchRequest {
            after_revision: Some(after),
            own_session: self.own_session,
            ..Default::default()
        };
        let deadline = Instant::now() + self.link.timeout;
        let (key, request) = (self.link.key("log"), request.encode_to_vec());
        self.link
            .attempt(CALL, &key, request.into(), deadline)
            .await
    }
}

fn number(revision: Option<&v1::Revision>) -> u64 {
    revision.map_or(0, |revision| revision.number)
}
