//! Answers on their way: replies, and refusals with the status that a failed gRPC call has.

use tonic::Status;
use tracing::debug;
use zenoh::{Wait, key_expr::KeyExpr, query::Query};

use super::{codec::Form, message::Named};
use crate::status;
use wayfold_proto::v1;

/// Sends an answer under `key`. Blocks while the caller's link is full of answers that it does not take, until Zenoh
/// gives the link up.
pub(super) fn reply(query: &Query, key: KeyExpr<'static>, form: Form, payload: Vec<u8>) {
    let sent = query.reply(key, payload).encoding(form.encoding()).wait();
    if let Err(error) = sent {
        debug!(key = %query.key_expr(), %error, "an answer could not be sent");
    }
}

/// Sends a refusal. Blocks as [`reply`] does.
pub(super) fn refuse(query: &Query, form: Form, status: &Status) {
    let message = status::to_message(status);
    let payload = form.write(v1::Status::NAME, &message);
    let payload = payload.unwrap_or_else(|error| error.to_string().into_bytes());
    let sent = query.reply_err(payload).encoding(form.encoding()).wait();
    if let Err(error) = sent {
        debug!(%error, "a refusal could not be sent");
    }
}
