//! Responses to queries: replies, or a refusal with the status that a failed gRPC call has.

use std::sync::Arc;

use tokio::sync::OwnedSemaphorePermit;
use tokio_util::task::task_tracker::TaskTrackerToken;
use tracing::debug;
use zenoh::{Wait, key_expr::KeyExpr, query::Query};

use super::encoding::encoding;
use crate::{admission::HeldBytes, status::Status, verbs::Form};

/// The replies to one query, each under its own key.
pub(super) type Replies = Vec<(KeyExpr<'static>, Vec<u8>)>;

/// A query and its result.
pub(super) struct Response {
    pub(super) query: Query,
    pub(super) form: Form,
    pub(super) result: Result<Replies, Status>,
    /// The permit of the query or of its refusal; `None` for a refusal beyond the limit of those.
    pub(super) place: Option<OwnedSemaphorePermit>,
    /// The bytes of the query and of its replies.
    pub(super) held: Option<Arc<HeldBytes>>,
    pub(super) under_way: TaskTrackerToken,
}

/// The bytes of all replies.
pub(super) fn reply_bytes(replies: &Replies) -> usize {
    replies.iter().map(|(_, payload)| payload.len()).sum()
}

impl Response {
    /// The bytes of all replies.
    pub(super) fn bytes(&self) -> usize {
        self.result.as_ref().map_or(0, reply_bytes)
    }

    /// Sends the result. Blocks as [`reply`] does.
    pub(super) fn send(self) {
        let Self {
            query,
            form,
            result,
            place,
            held,
            under_way,
        } = self;
        match result {
            Ok(replies) => {
                for (key, payload) in replies {
                    reply(&query, key, form, payload);
                }
            }
            Err(status) => reply_err(&query, form, &status),
        }
        // The drop ends the query for the caller, before its place is free.
        drop(query);
        drop((place, held));
        drop(under_way);
    }
}

/// Sends an answer under `key`. Blocks while the caller's link is full of unread answers, until Zenoh closes the link.
fn reply(query: &Query, key: KeyExpr<'static>, form: Form, payload: Vec<u8>) {
    let sent = query.reply(key, payload).encoding(encoding(form)).wait();
    if let Err(error) = sent {
        debug!(key = %query.key_expr(), %error, "an answer could not be sent");
    }
}

/// Sends a refusal. Blocks as [`reply`] does.
fn reply_err(query: &Query, form: Form, status: &Status) {
    let payload = form.write(&status.to_message());
    let payload = payload.unwrap_or_else(|error| error.to_string().into_bytes());
    let sent = query.reply_err(payload).encoding(encoding(form)).wait();
    if let Err(error) = sent {
        debug!(%error, "a refusal could not be sent");
    }
}
