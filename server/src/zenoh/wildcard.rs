//! Queries with a wildcard: they reach only `list` and the `info` of every index.

use wayfold_proto::v1;
use zenoh::key_expr::{KeyExpr, OwnedKeyExpr, keyexpr};

use super::response::Replies;
use crate::{
    service::{Call, Error, Service},
    status,
    verbs::{Form, invalid},
};

/// Indices described at a time, whose descriptions nothing counts.
const PAGE_ROWS: u32 = 100;

/// A reply takes about this many bytes besides its payload and its key.
const REPLY_BYTES: usize = 128;

/// The answers to a query for `key_expr`, which has a wildcard. The call holds their bytes while they are made.
pub(super) async fn answer(
    service: &Service,
    call: &Call,
    prefix: &str,
    key_expr: &keyexpr,
    form: Form,
) -> Result<Replies, Error> {
    let list = key(format!("{prefix}/list"))?;
    let lists = key_expr.intersects(&list);
    if !lists && !key_expr.intersects(&key(format!("{prefix}/*/info"))?) {
        let text = format!(
            "a wildcard reaches only {prefix}/list and {prefix}/INDEX/info: name the index and the verb"
        );
        return Err(invalid("key", "WILDCARD", text));
    }
    let mut pace = call.pace("while describing the indices");
    let mut held = call.answer_bytes();
    let mut replies = Replies::new();
    if lists {
        let listed = service.list_indexes(call, v1::ListIndexesRequest::default());
        let listed = status::listing(listed.await?);
        let payload = form.write(&listed)?;
        held.take(REPLY_BYTES + list.as_str().len() + payload.len())?;
        replies.push((list.into(), payload));
    }
    let mut request = v1::ListIndexesRequest {
        page_size: PAGE_ROWS,
        ..Default::default()
    };
    loop {
        let page = service.list_indexes(call, request.clone()).await?;
        for index in page.indexes {
            let info = key(format!("{prefix}/{}/info", index.name))?;
            if key_expr.intersects(&info) {
                let response = v1::GetIndexResponse { index: Some(index) };
                let payload = form.write(&response)?;
                held.take(REPLY_BYTES + info.as_str().len() + payload.len())?;
                replies.push((KeyExpr::from(info), payload));
            }
            pace.step().await?;
        }
        request.page_token = page.next_page_token;
        if request.page_token.is_empty() {
            return Ok(replies);
        }
    }
}

/// A key under the prefix. It is valid: the prefix was checked when the face opened, and names are plain.
fn key(text: String) -> Result<OwnedKeyExpr, Error> {
    OwnedKeyExpr::try_from(text).map_err(|error| Error::Internal {
        what: format!("a key of ours is none: {error}"),
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::{
        log::{Catalogue, Entry, MemoryLog},
        testing::{admission, arm, server},
    };

    #[tokio::test]
    async fn replies_hold_bytes_while_they_are_made_and_are_refused_without_room() {
        const MAX_BYTES: usize = 64 * 1024;
        let log = Arc::new(MemoryLog::new());
        for number in 0..250 {
            let entry = Entry {
                name: format!("arm{number}"),
                ..arm()
            };
            log.create(entry).unwrap();
        }
        let service = server(&log, &log);
        let admission = admission(MAX_BYTES);
        let (other, flow) = (admission.open().hold(), admission.open());
        let call = Call {
            held: Some(Arc::new(flow.hold())),
            ..Call::default()
        };
        let key = keyexpr::new("wayfold/v1/**").unwrap();
        let ask = async || answer(&service, &call, "wayfold/v1", key, Form::Json).await;
        // Only flows that hold little may take the last eighth.
        other.force_take(MAX_BYTES / 8 * 7 + 1);
        let refused = ask().await.map(|replies| replies.len());
        assert!(
            matches!(refused, Err(Error::TooManyBytes { .. })),
            "{refused:?}"
        );
        assert_eq!(flow.held(), 0);
        other.release_all();
        // The list is a reply too.
        assert_eq!(ask().await.unwrap().len(), 251);
        assert_eq!(flow.held(), 0);
    }
}
