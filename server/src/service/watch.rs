//! `Watch`: the mutations of an index as they become readable.

use std::{collections::VecDeque, sync::Arc};

use wayfold_proto::v1;

use super::{Call, Error, Service, at::failed, check::Violations};
use crate::{
    log::{LogError, Record},
    registry::{Hosted, RegistryError},
};

/// About how many bytes a message has; less if answers may have less.
const MESSAGE_BYTES: usize = 256 * 1024;

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
    payloads: bool,
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
        if request.after_revision.is_some() && request.uid.is_empty() {
            let text = "after_revision needs the uid of the index it belongs to";
            violations.add("uid", "REQUIRED", text);
        }
        if request.after_revision == Some(u64::MAX) {
            let text = "it is the greatest revision: none comes after it";
            violations.add("after_revision", "OUT_OF_RANGE", text);
        }
        let hosted = self.index(&request.index, "")?;
        violations.finish()?;
        let is_strange = !request.uid.is_empty() && request.uid != hosted.uid_text();
        Ok(Watch {
            service: self.clone(),
            call: *call,
            after: request.after_revision.unwrap_or_default(),
            from_newest: request.after_revision.is_none(),
            next: VecDeque::new(),
            sent: (0, 0),
            payloads: request.payloads,
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
                let message = self.message();
                if self.from_newest {
                    // Not what was the newest when the call began: the message is to name it.
                    self.after = message.revision;
                }
                Ok(message)
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

    fn message(&self) -> v1::WatchResponse {
        v1::WatchResponse {
            uid: self.hosted.uid_text().into(),
            revision: self.hosted.published().revision,
            ..Default::default()
        }
    }

    fn reset(&mut self, reason: v1::ResetReason) -> v1::WatchResponse {
        self.state = State::Done;
        v1::WatchResponse {
            reset: reason.into(),
            ..self.message()
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
                Err(error) => return Err(failed(self.hosted.name(), error)),
            }
        }
        let mut message = self.message();
        let mut left = self.message_bytes;
        while left > 0
            && let Some(record) = self.next.front().cloned()
        {
            let (sent, pieces) = self.sent;
            let (mut piece, sent) = piece(&record, sent, self.payloads, &mut left);
            piece.piece = pieces;
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
        reached.map_err(|error| failed(self.hosted.name(), error))?;
        Ok(())
    }
}

/// What follows the first `sent` points and removed ids of a record, as much of it as there are bytes `left`, but at
/// least one; and how many were sent then.
fn piece(record: &Record, sent: usize, payloads: bool, left: &mut usize) -> (v1::Mutation, usize) {
    let effects = record.effects();
    let stored = effects.stored();
    let (mut points, mut states) = (v1::Points::default(), v1::States::default());
    let mut at = sent;
    while at < stored.len() && (*left > 0 || at == sent) {
        let point = stored.get(at);
        points.ids.push(point.id);
        points.tags.push(point.tag);
        points.revisions.push(point.revision);
        states.rows += 1;
        states.coordinates.extend_from_slice(point.row);
        let mut bytes = 8 * point.row.len() + 28;
        if payloads {
            let payload = effects.payload(at);
            bytes += payload.len() + 8;
            points.payloads.push(payload);
        }
        *left = left.saturating_sub(bytes);
        at += 1;
    }
    points.states = Some(states);
    let mut removed_ids = Vec::new();
    while at >= stored.len() && at < effects.len() && (*left > 0 || at == sent) {
        removed_ids.push(effects.removed()[at - stored.len()]);
        *left = left.saturating_sub(8);
        at += 1;
    }
    // For the mutation itself.
    *left = left.saturating_sub(64);
    let mutation = v1::Mutation {
        revision: record.revision(),
        time_ms: record.time_ms(),
        stored: (!points.ids.is_empty()).then_some(points),
        removed_ids,
        continued: at < effects.len(),
        piece: 0,
    };
    (mutation, at)
}
