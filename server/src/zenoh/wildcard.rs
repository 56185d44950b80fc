//! Queries with a wildcard: they reach only `list` and the `info` of every index.

use wayfold_proto::v1;
use zenoh::key_expr::{KeyExpr, OwnedKeyExpr, keyexpr};

use super::response::Replies;
use crate::{
    service::{Call, Error, Service},
    status,
    verbs::{Form, invalid},
};

/// Indices described at a time.
const PAGE_ROWS: u32 = 1000;

/// The answers to a query for `key_expr`, which has a wildcard.
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
    let mut replies = Replies::new();
    if lists {
        let listed = service.list_indexes(call, v1::ListIndexesRequest::default());
        let listed = status::listing(listed.await?);
        let payload = form.write(&listed)?;
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
                replies.push((KeyExpr::from(info), payload));
            }
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
