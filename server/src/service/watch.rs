//! `Watch`: the mutations of an index as they become readable.

use std::{collections::VecDeque, sync::Arc};

use wayfold_proto::v1;

use super::{
    Call, Error, Service, answer::PointColumns, check::Violations, error_map::registry_error,
    read_view::revision,
};
use crate::{
    log::{LogError, Record},
    registry::{Hosted, RegistryError},
};

/// About how many bytes a message has; less if answers may have less.
const MESSAGE_BYTES: usize = 256 * 1024;

/// About how many bytes a mutation has besides what it stored and removed.
const MUTATION_BYTES: usize = 128;

/// A watch under way. It holds no revision, and no more mutations than a message has: what its caller does not ask for
/// stays in the log, until that forgets it.
pub struct Watch {
    service: Service,
    call: Call,
    hosted: Arc<Hosted>,
    /// The newest revision of which all was sent; never the greatest number, so that one comes after it.
    after: u64,
    /// Whether it begins at the newest revision, which the first message names.
    from_newest: bool,
    /// What comes next, as far as it was read.
    next: VecDeque<Arc<Record>>,
    /// How many points and removed ids of the first of these were sent, and in how many pieces.
    sent: (usize, u32),
    include: Option<v1::Include>,
    message_bytes: usize,
    state: State,
}

#[derive(PartialEq)]
enum State {
    /// Nothing was sent.
    Beginning,
    /// The caller knows another past.
    Strange,
    Going,
    Done,
}

impl Service {
    /// Begins to follow an index.
    pub async fn watch(&self, call: &Call, request: v1::WatchRequest) -> Result<Watch, Error> {
        self.accept(call)?;
        let mut violations = Violations::default();
        let after = request.after_revision;
        if after.as_ref().is_some_and(|after| after.uid.is_empty()) {
            let text = "a revision needs the uid of the index that it belongs to";
            violations.add("after_revision.uid", "REQUIRED", text);
        }
        if after.as_ref().is_some_and(|it| it.number == u64::MAX) {
            let text = "it is the greatest revision: none comes after it";
            violations.add("after_revision.number", "OUT_OF_RANGE", text);
        }
        let hosted = self.index(&request.index, "")?;
        violations.finish()?;
        let is_strange = |after: &v1::Revision| after.uid != hosted.uid_text();
        let is_strange = after.as_ref().is_some_and(is_strange);
        Ok(Watch {
            service: self.clone(),
            call: *call,
            from_newest: after.is_none(),
            after: after.map_or(0, |after| after.number),
            next: VecDeque::new(),
            sent: (0, 0),
            include: request.include,
            message_bytes: MESSAGE_BYTES.min(self.limits().answer_bytes / 2),
            state: match is_strange {
                true => State::Strange,
                false => State::Beginning,
            },
            hosted,
        })
    }
}

impl Watch {
    /// The next message; None after the last. None follows an error. A message that is not waited for to its end is not
    /// lost: the next one begins where it began.
    pub async fn next(&mut self) -> Option<Result<v1::WatchResponse, Error>> {
        let message = match self.state {
            State::Done => return None,
            State::Strange => Ok(self.reset(v1::ResetReason::UidChanged)),
            State::Beginning => {
                self.state = State::Going;
                let newest = self.hosted.published().revision;
                if self.from_newest {
                    // Not what was the newest when the call began: the message is to name it.
                    self.after = newest;
                }
                Ok(self.message(newest))
            }
            State::Going => self.mutations().await,
        };
        if message.is_err() {
            self.state = State::Done;
        }
        Some(message)
    }

    /// The same with messages of about so many bytes. A message has less than a payload more.
    pub fn with_message_bytes(self, message_bytes: usize) -> Self {
        Self {
            message_bytes,
            ..self
        }
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
            let read = self.hosted.mutations(self.after, self.message_bytes);
            match self.call.bound("while watching", read).await? {
                Ok(records) => self.next = records.into(),
                Err(RegistryError::Log(LogError::Trimmed { .. })) => {
                    return Ok(self.reset(v1::ResetReason::WindowPassed));
                }
                Err(error) => return Err(registry_error(self.hosted.name(), error)),
            }
        }
        let mut message = self.message(self.hosted.published().revision);
        let mut left = self.message_bytes;
        while left > 0
            && let Some(record) = self.next.front().cloned()
        {
            let (sent, pieces) = self.sent;
            let (mut piece, sent) = piece(&record, sent, self.include, &mut left);
            piece.piece = pieces;
            piece.revision = Some(revision(&self.hosted, record.revision()));
            self.sent = (sent, pieces + 1);
            if !piece.continued {
                self.after = record.revision();
                self.sent = (0, 0);
                self.next.pop_front();
            }
            message.mutations.push(piece);
        }
        Ok(message)
    }

    /// Waits until there is a mutation to send.
    async fn wait(&self) -> Result<(), Error> {
        let reached = self.hosted.reached(self.after + 1);
        let reached = self.call.bound("while watching", reached);
        let reached = tokio::select! {
            // Nobody would begin to stop while a call waits for what may never come.
            () = self.service.stopping() => return self.service.accept(&self.call),
            reached = reached => reached?,
        };
        reached.map_err(|error| registry_error(self.hosted.name(), error))?;
        Ok(())
    }
}

/// What follows the first `sent` points and removed ids of a record, as much of it as there are bytes `left`, but at
/// least one; and how many were sent then.
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
    // For the mutation itself.
    *left = left.saturating_sub(MUTATION_BYTES);
    let mutation = v1::Mutation {
        revision: None,
        time_ms: record.time_ms(),
        stored: (points.len() > 0).then(|| points.finish()),
        removed_ids,
        continued: at < effects.len(),
        piece: 0,
    };
    (mutation, at)
}
