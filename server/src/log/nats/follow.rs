//! The records of an index in the order of its stream, from a revision on.

use std::{sync::Arc, time::Duration};

use async_nats::jetstream::consumer::{AckPolicy, DeliverPolicy, pull};
use futures_util::{StreamExt, stream};
use tokio::time::{Interval, MissedTickBehavior, interval, timeout};
use tracing::{debug, warn};

use super::{
    RETRY_INTERVAL,
    connection::{Connection, unreachable, within},
    message::{PackPosition, Unpacker},
    tail::{AfterLook, LOOK_INTERVAL, TailLooks},
};
use crate::log::{Digest, LogError, Record, RecordStream, Uid};

/// A pull of this length notices a lost server of NATS after about as long.
const PULL_TIME: Duration = Duration::from_secs(2);

/// The most bytes of payloads that a pull asks for, or one message.
const PULL_BYTES: usize = 1024 * 1024;

/// A pull has room for these too: NATS counts the subjects and headers, and never sends a message that exceeds the pull.
const MAX_HEAD_BYTES: usize = 64 * 1024;

/// A follower asks again this many times, with [`RETRY_INTERVAL`] between, if the stream ends before its place: a new leader
/// of NATS may answer with an older state.
const MAX_BEHIND: u32 = 10;

/// A follower's place, and its subscription while it has one.
struct Follower {
    connection: Arc<Connection>,
    uid: Uid,
    /// The newest revision that was returned.
    after: u64,
    /// The digest of its record, if it is known.
    digest: Option<Digest>,
    messages: Option<pull::Stream>,
    unpacker: Unpacker,
    /// True if the last subscription brought a gap or damage next, and no record has come since.
    is_suspect: bool,
    /// The number of subscriptions in turn for which NATS lacked the newest returned record.
    behind: u32,
    looks: TailLooks,
    /// The times of subscriptions.
    attempts: Option<Interval>,
}

/// The records after the revision `after`, whose record has this digest if it is known. It waits for new ones, and while NATS
/// cannot be reached.
pub(super) fn follow(
    connection: Arc<Connection>,
    uid: Uid,
    after: u64,
    digest: Option<Digest>,
) -> RecordStream {
    let follower = Follower {
        connection,
        uid,
        after,
        digest,
        messages: None,
        unpacker: Unpacker::default(),
        is_suspect: false,
        behind: 0,
        looks: TailLooks::default(),
        attempts: None,
    };
    let batches = stream::unfold(Some(follower), |follower| async move {
        let mut follower = follower?;
        loop {
            match follower.next().await {
                Ok(records) if records.is_empty() => {}
                Ok(records) => return Some((Ok(records), Some(follower))),
                Err(LogError::Unreachable { what }) => {
                    debug!(uid = %follower.uid, what, "cannot read the stream in NATS");
                    follower.messages = None;
                    follower.unpacker = Unpacker::default();
                }
                Err(error) => return Some((Err(error), None)),
            }
        }
    });
    batches.boxed()
}

impl Follower {
    /// The next records; none if a message brought only known ones or a part of a pack, or if none came for
    /// [`LOOK_INTERVAL`].
    async fn next(&mut self) -> Result<Vec<Arc<Record>>, LogError> {
        let messages = match &mut self.messages {
            Some(messages) => messages,
            None => {
                let attempts = self.attempts.get_or_insert_with(|| {
                    let mut attempts = interval(RETRY_INTERVAL);
                    attempts.set_missed_tick_behavior(MissedTickBehavior::Delay);
                    attempts
                });
                attempts.tick().await;
                let subscribed =
                    subscribe(&self.connection, self.uid, self.after, self.digest).await;
                if let Err(LogError::JournalBehind { .. }) = &subscribed
                    && self.behind < MAX_BEHIND
                {
                    self.behind += 1;
                    let what = "the stream does not have the newest known record";
                    return Err(resubscribe(what));
                }
                self.behind = 0;
                self.messages.insert(subscribed?)
            }
        };
        let arrived = timeout(LOOK_INTERVAL, messages.next()).await;
        let message = match arrived {
            Ok(Some(Ok(message))) => message,
            Ok(Some(Err(error))) => return Err(unreachable(error)),
            Ok(None) => return Err(resubscribe("the subscription has ended")),
            Err(_) => return self.look().await,
        };
        let headers = message.headers.clone().unwrap_or_default();
        let next = self.after + 1;
        let taken = (self.unpacker).take(self.uid, next, &headers, &message.payload);
        let taken = taken.map(|mut records| {
            records.retain(|record| record.revision() > self.after);
            records
        });
        let is_whole = taken.as_ref().is_ok_and(|records| {
            let first = records.first();
            first.is_none_or(|first| first.revision() == next)
        });
        if !is_whole && !self.is_suspect {
            // The connection may have lost a message. If the stream has, the next subscription brings the same.
            self.is_suspect = true;
            return Err(resubscribe("a message is missing or damaged"));
        }
        let records = taken?;
        if let Some(last) = records.last() {
            (self.after, self.digest) = (last.revision(), Some(*last.digest()));
            self.is_suspect = false;
            self.looks = TailLooks::default();
        }
        Ok(records)
    }

    /// Compares its place with the end of the stream. Returns the next records if subscriptions do not bring them.
    async fn look(&mut self) -> Result<Vec<Arc<Record>>, LogError> {
        let end = match self.connection.last(self.uid).await {
            Ok(last) => last.last_record,
            // The subscription notices a lost server of NATS without this, and outlives a slow answer.
            Err(LogError::Unreachable { .. }) => return Ok(Vec::new()),
            Err(error) => return Err(error),
        };
        match self.looks.note(self.after, self.digest, end) {
            AfterLook::Wait => Ok(Vec::new()),
            AfterLook::Subscribe => Err(resubscribe("the stream ends at another record")),
            // A new leader of NATS may answer with an older state, so no answer is final here.
            AfterLook::Read => self.read_hidden().await.map_err(unreachable),
        }
    }

    /// Reads the next records without a subscription. Fails if the stream, which has them, does not give them. The looks keep
    /// their count until a subscription brings a record, so the next look reads on.
    async fn read_hidden(&mut self) -> Result<Vec<Arc<Record>>, LogError> {
        let (uid, after) = (self.uid, self.after);
        warn!(
            %uid,
            after,
            "no subscription brings the newest records of the stream in NATS: reading them one by one"
        );
        let records = read(&self.connection, uid, Some(after), PULL_BYTES).await?;
        let Some(last) = records.last() else {
            return Err(resubscribe("the stream does not give its newest records"));
        };
        (self.after, self.digest) = (last.revision(), Some(*last.digest()));
        self.is_suspect = false;
        // The next subscription begins after these records.
        self.messages = None;
        self.unpacker = Unpacker::default();
        Ok(records)
    }
}

/// An error after which a follower subscribes again, as it does while NATS cannot be reached.
fn resubscribe(what: &str) -> LogError {
    LogError::Unreachable { what: what.into() }
}

/// Subscribes to the messages of an index from the record after the revision `after` on. Revisions tell their order, so
/// no acknowledgement of a message is needed.
async fn subscribe(
    connection: &Connection,
    uid: Uid,
    after: u64,
    digest: Option<Digest>,
) -> Result<pull::Stream, LogError> {
    let last = connection.last(uid).await?;
    // For an older record the next one's link shows a replacement. The newest has no successor, so compare it here.
    if last.last_record.revision == after
        && digest.is_some_and(|digest| digest != last.last_record.digest)
    {
        return Err(LogError::replaced(uid, after));
    }
    let sequence = sequence_after(connection, uid, after, last).await?;
    let config = pull::Config {
        filter_subject: connection.subject(uid),
        deliver_policy: DeliverPolicy::ByStartSequence {
            start_sequence: sequence,
        },
        ack_policy: AckPolicy::None,
        inactive_threshold: 15 * PULL_TIME,
        memory_storage: true,
        num_replicas: 1,
        ..Default::default()
    };
    let subscribed = async {
        let consumer = connection.stream(uid).create_consumer(config).await;
        let consumer = consumer.map_err(unreachable)?;
        let messages = consumer
            .stream()
            .max_bytes_per_batch(connection.max_payload.max(PULL_BYTES) + MAX_HEAD_BYTES)
            .expires(PULL_TIME)
            .heartbeat(PULL_TIME / 4);
        messages.messages().await.map_err(unreachable)
    };
    within(subscribed).await
}

/// See [`Journal::read`](crate::log::Journal::read).
pub(super) async fn read(
    connection: &Connection,
    uid: Uid,
    after: Option<u64>,
    max_bytes: usize,
) -> Result<Vec<Arc<Record>>, LogError> {
    let after = after.unwrap_or(0);
    let last = connection.last(uid).await?;
    let mut sequence = sequence_after(connection, uid, after, last).await?;
    let (mut records, mut bytes, mut unpacker) = (Vec::new(), 0, Unpacker::default());
    while let Some((position, message)) = connection.next(uid, sequence).await? {
        sequence = position.sequence + 1;
        let next = position.first_revision;
        for record in unpacker.take(uid, next, &message.headers, &message.payload)? {
            let last = records
                .last()
                .map_or(after, |last: &Arc<Record>| last.revision());
            if record.revision() <= last {
                continue;
            }
            if record.revision() > last + 1 {
                let what = "its stream in NATS does not have it";
                return Err(LogError::journal_damaged(uid, last + 1, what));
            }
            bytes += record.effects().bytes();
            if bytes > max_bytes && !records.is_empty() {
                return Ok(records);
            }
            records.push(record);
        }
    }
    Ok(records)
}

/// Forgets the messages with records up to the revision `up_to` alone, but never the newest pack: see
/// [`Journal::forget`](crate::log::Journal::forget).
pub(super) async fn forget(connection: &Connection, uid: Uid, up_to: u64) -> Result<(), LogError> {
    let last = connection.last(uid).await?;
    let up_to = up_to.min(last.first_revision.saturating_sub(1));
    match connection.next(uid, 1).await? {
        Some((first, _)) if first.last_record.revision <= up_to => {}
        _ => return Ok(()),
    }
    match sequence_after(connection, uid, up_to, last).await? {
        // Another server has purged the messages meanwhile. NATS takes 1 for no bound and would purge the newest too.
        0 | 1 => Ok(()),
        sequence => connection.purge_before(uid, sequence).await,
    }
}

/// The sequence number from which the next message of the index holds the record after `after`. `last` is the newest
/// message.
async fn sequence_after(
    connection: &Connection,
    uid: Uid,
    after: u64,
    last: PackPosition,
) -> Result<u64, LogError> {
    if last.last_record.revision < after {
        return Err(LogError::JournalBehind {
            uid,
            head: last.last_record.revision,
            applied: after,
        });
    }
    if last.last_record.revision == after {
        return Ok(last.sequence + 1);
    }
    let Some((first, _)) = connection.next(uid, 1).await? else {
        return Ok(1);
    };
    if first.first_revision > after + 1 {
        return Err(LogError::trimmed(uid, after, first.first_revision - 1));
    }
    // The first message at or after `low` ends by `after`; the first at or after `high` ends later.
    let (mut low, mut high) = (first.sequence, last.sequence);
    if first.last_record.revision > after {
        return Ok(low);
    }
    while high - low > 1 {
        let middle = low + (high - low) / 2;
        match connection.next(uid, middle).await? {
            Some((found, _)) if found.last_record.revision <= after => {
                low = found.sequence.min(high - 1)
            }
            _ => high = middle,
        }
    }
    Ok(high)
}
