//! The publisher of an index: it publishes the submitted records in their order, one message at a time. Records that
//! arrive while one is under way leave together in the next. It first waits briefly for the next records of all writers
//! that shared the last one: three servers of NATS sync each message.

use std::{sync::Arc, time::Duration};

use async_nats::{
    header::{
        NATS_BATCH_COMMIT, NATS_BATCH_COMMIT_FINAL, NATS_BATCH_ID, NATS_BATCH_SEQUENCE,
        NATS_EXPECTED_LAST_SUBJECT_SEQUENCE,
    },
    jetstream::{
        ErrorCode,
        context::{PublishError, PublishErrorKind},
        message::PublishMessage,
        publish::PublishAck,
    },
};
use bytes::Bytes;
use tokio::{
    runtime::Handle,
    sync::{mpsc, oneshot},
    time::{Instant, interval, sleep_until, timeout, timeout_at},
};
use tracing::debug;
use uuid::Uuid;

use super::{
    RETRY_INTERVAL,
    connection::{self, Connection, MESSAGE_TIMEOUT, REQUEST_TIMEOUT},
    message::{self, PackPosition},
};
use crate::log::{LogError, Record, Uid};

/// The number of times that a message is sent again because NATS was about to store another one of its subject, or because
/// its stream had no leader.
const MAX_REPEATS: u64 = 100;

/// The longest wait for further records. It is about as long as the last message took, if that is less, and after a wait in
/// which none came the next message does not wait.
const MAX_WAIT: Duration = Duration::from_millis(5);

/// A message of this many bytes gets another [`MESSAGE_TIMEOUT`].
const BYTES_PER_TIMEOUT: usize = 1024 * 1024;

/// A publisher without a record for this long ends: a server may have thousands of indices.
const IDLE_TIME: Duration = Duration::from_secs(60);

/// A submitted record.
pub(super) struct Submission {
    pub(super) record: Arc<Record>,
    /// Its stored form.
    pub(super) stored: Vec<u8>,
    /// True if it is the first record of an index that begins at an origin.
    pub(super) begins: bool,
    /// Gets its outcome.
    pub(super) answer: oneshot::Sender<Result<(), LogError>>,
}

/// Starts a publisher. Once the sender is dropped, and after [`IDLE_TIME`] without a record, it publishes what it has and
/// ends.
pub(super) fn start(
    uid: Uid,
    connection: Arc<Connection>,
    runtime: &Handle,
) -> mpsc::UnboundedSender<Submission> {
    let (submissions, waiting) = mpsc::unbounded_channel();
    let publisher = Publisher {
        uid,
        connection,
        newest: None,
        connects: 0,
        writers: 1,
        linger: Duration::ZERO,
    };
    runtime.spawn(publisher.run(waiting));
    submissions
}

struct Publisher {
    uid: Uid,
    connection: Arc<Connection>,
    /// The newest message of the index, if it is known. Another server may have published since.
    newest: Option<PackPosition>,
    /// The number of connects of the client when `newest` was learnt, or a lower one. With another one it is unknown.
    connects: u64,
    /// An estimate of the number of writers: the records in the last message and those that waited for its end.
    writers: usize,
    /// The longest wait until each writer has a record in the message.
    linger: Duration,
}

impl Publisher {
    async fn run(mut self, mut waiting: mpsc::UnboundedReceiver<Submission>) {
        let mut left_over = None;
        loop {
            let first = match left_over.take() {
                Some(first) => first,
                None => match timeout(IDLE_TIME, waiting.recv()).await {
                    Ok(Some(first)) => first,
                    Ok(None) => return,
                    // A closed channel still yields the records that are queued.
                    Err(_) => {
                        waiting.close();
                        continue;
                    }
                },
            };
            let mut bytes = message::packed_bytes(first.stored.len());
            let mut batch = vec![first];
            let until = Instant::now() + self.linger;
            let mut came = false;
            loop {
                let next = match waiting.try_recv() {
                    Ok(next) => next,
                    Err(_) if batch.len() >= self.writers => break,
                    Err(_) => match timeout_at(until, waiting.recv()).await {
                        Ok(Some(next)) => {
                            came = true;
                            next
                        }
                        Ok(None) | Err(_) => break,
                    },
                };
                bytes += message::packed_bytes(next.stored.len());
                let follows = batch
                    .last()
                    .is_some_and(|last| next.record.follows(last.record.position()));
                if bytes > self.connection.max_payload || !follows {
                    left_over = Some(next);
                    break;
                }
                batch.push(next);
            }
            let in_vain = !came && batch.len() < self.writers && !self.linger.is_zero();
            let began = Instant::now();
            let outcome = self.publish(&batch).await;
            self.writers = batch.len() + waiting.len();
            self.linger = match in_vain {
                true => Duration::ZERO,
                false => began.elapsed().min(MAX_WAIT),
            };
            for submission in batch {
                let outcome = outcome.as_ref().copied().map_err(|why| match why {
                    Refusal::Fenced { head } => {
                        LogError::fenced(self.uid, submission.record.revision() - 1, *head)
                    }
                    Refusal::Unconfirmed { what } => LogError::Unconfirmed {
                        uid: self.uid,
                        revision: submission.record.revision(),
                        what: what.clone(),
                    },
                });
                // The apply loop may have ended.
                let _ = submission.answer.send(outcome);
            }
        }
    }

    /// Publishes consecutive records as one pack.
    async fn publish(&mut self, batch: &[Submission]) -> Result<(), Refusal> {
        let (Some(first), Some(last)) = (batch.first(), batch.last()) else {
            return Ok(());
        };
        let begins = first.begins;
        let (first, last) = (&*first.record, &*last.record);
        let mut payload = Vec::new();
        for submission in batch {
            message::pack(&mut payload, &submission.stored);
        }
        let payload = Bytes::from(payload);
        let expected = self.place_before(first, begins).await?;
        let mut attempts = interval(RETRY_INTERVAL);
        for repeat in 0..MAX_REPEATS {
            let sent = self.send(first, last, &payload, expected.sequence);
            let limit = match begins {
                true => REQUEST_TIMEOUT,
                false => MESSAGE_TIMEOUT * (1 + payload.len() / BYTES_PER_TIMEOUT) as u32,
            };
            let sent = timeout(limit, sent).await;
            // Without an acknowledgement the message may be in the stream, or come to it.
            self.newest = None;
            let acknowledged = sent.map_err(|_| Refusal::Unconfirmed {
                what: "no acknowledgement in time".into(),
            })?;
            let error = match acknowledged {
                Ok(acknowledgement) => {
                    self.newest = Some(PackPosition {
                        sequence: acknowledgement.sequence,
                        first_revision: first.revision(),
                        last_record: last.position(),
                    });
                    return Ok(());
                }
                Err(error) => error,
            };
            match error.kind() {
                // The newest message may be this one, if an earlier acknowledgement was lost.
                PublishErrorKind::WrongLastSequence => {
                    let newest = self.read_newest().await?;
                    if newest.last_record == last.position() {
                        return Ok(());
                    }
                    if newest != expected {
                        let head = newest.last_record.revision;
                        return Err(Refusal::Fenced { head });
                    }
                    // NATS answered with stale data: it has just refused this number.
                    attempts.tick().await;
                }
                // No server has received it: the stream has no leader now.
                PublishErrorKind::StreamNotFound => {
                    attempts.tick().await;
                }
                // NATS also refuses a correct number while it stores another message. That takes milliseconds, or until
                // its servers have chosen a leader.
                PublishErrorKind::Other
                    if connection::code(&error)
                        == Some(ErrorCode::STREAM_WRONG_LAST_SEQUENCE_CONSTANT) =>
                {
                    sleep_until(Instant::now() + Duration::from_millis(repeat)).await;
                }
                _ => {
                    debug!(uid = %self.uid, %error, "no acknowledgement from NATS");
                    return Err(Refusal::Unconfirmed {
                        what: error.to_string(),
                    });
                }
            }
        }
        Err(Refusal::Unconfirmed {
            what: format!("NATS has refused it {MAX_REPEATS} times"),
        })
    }

    /// Publishes a pack behind the message `expected`, all of it or nothing.
    async fn send(
        &self,
        first: &Record,
        last: &Record,
        pack: &Bytes,
        expected: u64,
    ) -> Result<PublishAck, PublishError> {
        let (context, subject) = (&self.connection.context, self.connection.subject(self.uid));
        let client = context.client();
        let parts = message::part_count(pack.len(), self.connection.max_payload);
        let batch = Uuid::new_v4().to_string();
        for part in 1..=parts {
            let start = (part - 1) * self.connection.max_payload;
            let end = pack.len().min(start + self.connection.max_payload);
            let mut headers = message::headers(first, last, part, parts);
            if part == 1 {
                headers.insert(NATS_EXPECTED_LAST_SUBJECT_SEQUENCE, expected.to_string());
            }
            if parts > 1 {
                headers.insert(NATS_BATCH_ID, &*batch);
                headers.insert(NATS_BATCH_SEQUENCE, part.to_string());
            }
            let payload = pack.slice(start..end);
            if part < parts {
                // The end of the batch tells of an error here.
                let sent = client.publish_with_headers(subject.clone(), headers, payload);
                let failed = |error| PublishError::with_source(PublishErrorKind::Other, error);
                sent.await.map_err(failed)?;
                continue;
            }
            if parts > 1 {
                headers.insert(NATS_BATCH_COMMIT, NATS_BATCH_COMMIT_FINAL);
            }
            let message = PublishMessage::build().payload(payload).headers(headers);
            return context.send_publish(subject, message).await?.await;
        }
        unreachable!("a pack has a record")
    }

    /// The message that `record` follows. One that `begins` an index follows none.
    async fn place_before(
        &mut self,
        record: &Record,
        begins: bool,
    ) -> Result<PackPosition, Refusal> {
        let connects = self.connection.connects();
        if connects != self.connects {
            // NATS may have lost its newest messages meanwhile, and gives their sequence numbers to others.
            (self.newest, self.connects) = (None, connects);
        }
        if let Some(newest) = self.newest
            && record.follows(newest.last_record)
        {
            return Ok(newest);
        }
        let newest = self.read_newest().await?;
        match record.follows(newest.last_record) || begins && newest == PackPosition::START {
            true => Ok(newest),
            false => Err(Refusal::Fenced {
                head: newest.last_record.revision,
            }),
        }
    }

    async fn read_newest(&mut self) -> Result<PackPosition, Refusal> {
        self.newest = None;
        let newest = self.connection.last(self.uid).await;
        let newest = newest.map_err(|error| Refusal::Unconfirmed {
            what: error.to_string(),
        })?;
        self.newest = Some(newest);
        Ok(newest)
    }
}

/// The end of a message that was not acknowledged.
#[derive(Clone)]
enum Refusal {
    /// Another record has the place of its first, or it does not follow the newest, which is `head`.
    Fenced { head: u64 },
    /// It may be in the stream or not.
    Unconfirmed { what: String },
}
