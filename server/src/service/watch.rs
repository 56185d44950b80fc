//! `Watch`: the mutations of an index as they become readable.

mod journal_read;

use std::{collections::VecDeque, ops::Range, pin::pin, sync::Arc, time::Duration};

use tokio::time::timeout;
use wayfold_proto::v1;

use super::{
    Call, Error, Service,
    answer::PointColumns,
    check::Violations,
    error_map::registry_error,
    read_view::{check_uid, revision, uid_is_named, uid_of},
};
use crate::{
    admission::HeldBytes,
    identity::Role,
    log::{LogError, Outcome, Record},
    registry::{Hosted, MAX_CUT_OFF_CHECKS, RegistryError, Subscriber},
};

/// Approximate bytes of a message, less if answers are limited to less.
const MESSAGE_BYTES: usize = 256 * 1024;

/// Approximate bytes of a mutation without its points and removed ids.
const MUTATION_BYTES: usize = 128;

/// The time between two checks of the rights of a watch that waits, and of the journal. A watch ends after
/// [`MAX_CUT_OFF_CHECKS`] of a journal that cannot be reached, or after one if it began like that: its client goes on at
/// another server.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// A running watch. It pins no revision and holds the mutations of one message at most, or one mutation: the log keeps the
/// rest, for as long as it retains them. A mutation that the log trims between two of its pieces ends the watch.
pub struct Watch {
    service: Service,
    call: Call,
    hosted: Arc<Hosted>,
    /// Set once the first revision is known.
    subscriber: Option<Subscriber>,
    /// True if the reader counts among the subscribers of the index.
    is_counted: bool,
    /// The newest revision that was sent whole; below the greatest number, so that its successor exists.
    after: u64,
    /// True if the watch begins at the newest revision, which the first message names.
    from_newest: bool,
    /// The next records, as far as they were read.
    next: VecDeque<Arc<Record>>,
    /// True if they came from memory.
    is_cached: bool,
    /// The bytes of records that were read from the journal.
    ahead: Option<Arc<HeldBytes>>,
    /// The points and removed ids of the first record that were sent, and the number of pieces.
    sent: (usize, u32),
    include: Option<v1::Include>,
    /// The points of the last message whose states took the place of others: each with the revision that stored it.
    replaced: Vec<(u64, u64)>,
    /// The session whose mutations come without points and removed ids; 0 is no session.
    own_session: u64,
    message_bytes: usize,
    /// The checks so far that found the journal out of reach, as the next wait counts them.
    cut_off_checks: u32,
    state: State,
}

#[derive(PartialEq)]
enum State {
    /// Nothing was sent.
    Beginning,
    /// The caller's uid is another one.
    OtherUid,
    Following,
    Done,
}

impl Service {
    /// Begins to follow an index.
    pub async fn watch(&self, call: &Call, request: v1::WatchRequest) -> Result<Watch, Error> {
        let after = request.after_revision;
        let uid = uid_of(after.as_ref());
        let hosted = self.index_named(call, Role::Read, &request.index_name, uid)?;
        let mut violations = Violations::default();
        if let Some(after) = &after {
            uid_is_named("after_revision", &after.uid, &mut violations);
        }
        if after.as_ref().is_some_and(|it| it.number == u64::MAX) {
            let text = "it is the greatest revision: none comes after it";
            violations.add("after_revision.number", "OUT_OF_RANGE", text);
        }
        violations.finish()?;
        if after.is_none() {
            self.published_now(call, &hosted).await?;
        }
        let checked = check_uid(&hosted, uid);
        if let Err(unknown @ Error::UidUnknown { .. }) = checked {
            return Err(unknown);
        }
        Ok(Watch {
            service: self.clone(),
            call: call.clone(),
            subscriber: None,
            is_counted: true,
            from_newest: after.is_none(),
            after: after.map_or(0, |after| after.number),
            next: VecDeque::new(),
            is_cached: false,
            ahead: None,
            sent: (0, 0),
            include: request.include,
            replaced: Vec::new(),
            own_session: request.own_session,
            message_bytes: MESSAGE_BYTES.min(self.limits().max_answer_bytes / 2),
            cut_off_checks: match self.registry()?.is_cut_off() {
                true => MAX_CUT_OFF_CHECKS - 1,
                false => 0,
            },
            state: match checked {
                Ok(()) => State::Beginning,
                Err(_) => State::OtherUid,
            },
            hosted,
        })
    }
}

impl Watch {
    /// Does not count this watch among the index's subscribers.
    pub(crate) fn uncounted(self) -> Self {
        Self {
            is_counted: false,
            ..self
        }
    }

    /// Waits until there is a message to send. Returns about how many bytes making it takes. A cancelled call loses nothing.
    pub(crate) async fn next_bytes(&mut self) -> Result<usize, Error> {
        if self.state != State::Following {
            return Ok(0);
        }
        if self.next.is_empty()
            && let Err(error) = self.wait().await
        {
            self.state = State::Done;
            return Err(error);
        }
        // It counts what it reads, and then makes the message at once.
        Ok(MUTATION_BYTES)
    }

    /// Lets `ahead` count the mutations that it has read and not sent.
    pub(crate) fn with_read_ahead(self, ahead: HeldBytes) -> Self {
        Self {
            ahead: Some(Arc::new(ahead)),
            ..self
        }
    }

    /// Forgets the mutations that it has read and not sent: they are read again.
    pub(crate) fn forget_read_ahead(&mut self) {
        self.next = VecDeque::new();
        if let Some(ahead) = &self.ahead {
            ahead.release_all();
        }
    }

    /// The mutations after those that were sent. They come from memory, which many share, or are read and counted.
    async fn read(&mut self) -> Result<Vec<Arc<Record>>, RegistryError> {
        let (after, most) = (self.after, self.message_bytes);
        let cached = self.hosted.cached_mutations(after, most);
        self.is_cached = cached.is_some();
        if let Some(records) = cached {
            return Ok(records);
        }
        journal_read::read(Arc::clone(&self.hosted), after, most, self.ahead.clone()).await
    }

    /// The next message; None after the last or an error. A cancelled call loses no message: the next call begins where
    /// it began.
    pub async fn next(&mut self) -> Option<Result<v1::WatchResponse, Error>> {
        let message = match self.state {
            State::Done => return None,
            State::OtherUid => Ok(self.reset(v1::ResetReason::UidChanged)),
            State::Beginning => {
                self.state = State::Following;
                let newest = self.hosted.published().revision;
                if self.from_newest {
                    // The newest revision now, not at the call's start: the message names it.
                    self.after = newest;
                }
                if self.is_counted {
                    self.subscriber = Some(self.hosted.subscribers.join(self.after));
                }
                Ok(self.message(newest))
            }
            State::Following => self.mutations().await,
        };
        if message.is_err() {
            self.state = State::Done;
        }
        Some(message)
    }

    /// Sets the approximate bytes of a message. A message exceeds them by less than one point.
    pub fn with_message_bytes(self, message_bytes: usize) -> Self {
        Self {
            message_bytes,
            ..self
        }
    }

    /// The points of the last message whose states took the place of others: the revision that stored each, and its id.
    pub(crate) fn replaced(&self) -> &[(u64, u64)] {
        &self.replaced
    }

    fn message(&self, newest: u64) -> v1::WatchResponse {
        v1::WatchResponse {
            revision: Some(revision(&self.hosted, newest)),
            ..Default::default()
        }
    }

    fn reset(&mut self, reason: v1::ResetReason) -> v1::WatchResponse {
        self.state = State::Done;
        v1::WatchResponse {
            reset: Some(reason.into()),
            ..self.message(self.hosted.published().revision)
        }
    }

    async fn mutations(&mut self) -> Result<v1::WatchResponse, Error> {
        while self.next.is_empty() {
            self.wait().await?;
            let call = self.call.clone();
            match call.bound("while watching", self.read()).await? {
                Ok(records) => {
                    self.next = records.into();
                    self.cut_off_checks = 0;
                }
                Err(RegistryError::Log(LogError::Trimmed { .. })) => {
                    return Ok(self.reset(v1::ResetReason::WindowPassed));
                }
                Err(error) => return Err(registry_error(self.hosted.name(), error)),
            }
        }
        // The wait may have been long.
        self.call.check("while watching")?;
        let mut message = self.message(self.hosted.published().revision);
        let mut left = self.message_bytes;
        self.replaced.clear();
        while left > 0
            && let Some(record) = self.next.front().cloned()
        {
            let (sent, pieces) = self.sent;
            let (session, batch) = written_by(&record);
            let (piece, sent) = match session {
                // The caller knows the effects of its own batch.
                1.. if session == self.own_session => (v1::Mutation::default(), 0),
                _ => piece(&record, sent, self.include, &mut left),
            };
            let sent_rows = self.sent.0..sent.min(record.effects().stored().len());
            self.replaced.extend(replaced(&record, sent_rows));
            let piece = v1::Mutation {
                revision: Some(revision(&self.hosted, record.revision())),
                time_ms: record.time_ms(),
                piece: pieces,
                session,
                batch,
                ..piece
            };
            // For the mutation itself.
            left = left.saturating_sub(MUTATION_BYTES);
            self.sent = (sent, pieces + 1);
            if !piece.continued {
                self.after = record.revision();
                if let Some(subscriber) = &self.subscriber {
                    subscriber.advance_to(self.after);
                }
                self.sent = (0, 0);
                self.next.pop_front();
            }
            message.mutations.push(piece);
        }
        // The bytes that the call has read ahead count beside its next part.
        let has_room = |ahead: &Arc<HeldBytes>| ahead.further().has_room(0);
        let has_room = self.ahead.as_ref().is_none_or(has_room);
        if self.is_cached || !has_room || self.next.is_empty() {
            self.forget_read_ahead();
        }
        Ok(message)
    }

    /// Waits until there is a mutation to send.
    async fn wait(&self) -> Result<(), Error> {
        let reached = self.hosted.reached(self.after + 1);
        let mut reached = pin!(self.call.bound("while watching", reached));
        let mut cut_off = self.cut_off_checks;
        let reached = loop {
            let waited = tokio::select! {
                // Without this branch a call that waits for a mutation would delay the shutdown forever.
                () = self.service.stopping() => return self.service.accept(&self.call, Role::Read, None),
                waited = timeout(CHECK_INTERVAL, &mut reached) => waited,
            };
            match waited {
                Ok(reached) => break reached?,
                // An idle watch ends with its identity too.
                Err(_) => self.service.accept(&self.call, Role::Read, None)?,
            }
            cut_off = match self.service.registry()?.is_cut_off() {
                true => cut_off + 1,
                false => 0,
            };
            if cut_off >= MAX_CUT_OFF_CHECKS {
                let error = LogError::Unreachable {
                    what: "its connection is lost".into(),
                };
                return Err(registry_error(self.hosted.name(), error.into()));
            }
        };
        reached.map_err(|error| registry_error(self.hosted.name(), error))?;
        Ok(())
    }
}

/// The writer session and the number of its batch that made a record; zeros if no batch did.
fn written_by(record: &Record) -> (u64, u64) {
    match record.effects().batch() {
        // Batch 0 opens a session.
        Some(batch) if batch.number > 0 => (batch.session, batch.number),
        _ => (0, 0),
    }
}

/// The points of a record, of those in `range`, whose states took the place of others: its revision and their ids.
fn replaced(record: &Record, range: Range<usize>) -> impl Iterator<Item = (u64, u64)> {
    let revision = record.revision();
    let effects = record.effects();
    let replaced = range.filter(|at| effects.outcomes()[*at] == Outcome::Replaced);
    let points = replaced.map(|at| effects.stored().get(at));
    // The state is the same where only the tag or the payload is new.
    let points = points.filter(move |point| point.revision == revision);
    points.map(move |point| (revision, point.id))
}

/// The next piece of a record after its first `sent` points and removed ids: as many as fit `left` bytes, at least one.
/// Returns the piece and the new count of `sent`.
fn piece(
    record: &Record,
    sent: usize,
    include: Option<v1::Include>,
    left: &mut usize,
) -> (v1::Mutation, usize) {
    let effects = record.effects();
    let stored = effects.stored();
    let mut points = PointColumns::new(include);
    let mut at = sent;
    while at < stored.len() && (points.bytes() < *left || at == sent) {
        let payload = points.with_payloads().then(|| effects.payload(at));
        points.push(stored.get(at), payload);
        at += 1;
    }
    *left = left.saturating_sub(points.bytes());
    let mut removed_ids = Vec::new();
    while at >= stored.len() && at < effects.len() && (*left > 0 || at == sent) {
        removed_ids.push(effects.removed()[at - stored.len()]);
        *left = left.saturating_sub(8);
        at += 1;
    }
    let mutation = v1::Mutation {
        stored: (points.len() > 0).then(|| points.finish()),
        removed_ids,
        continued: at < effects.len(),
        ..Default::default()
    };
    (mutation, at)
}

#[cfg(test)]
mod tests;
