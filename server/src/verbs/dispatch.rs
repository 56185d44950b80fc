//! Translates a verb to a call of the service, and its answer to a payload. No policy is here.

use std::pin::Pin;

use prost::Name;
use wayfold_proto::v1;

use super::{codec::invalid, request::Request, verb::Verb};
use crate::{
    observe,
    service::{Call, Error, Service},
    status,
};

const NEEDS_OPERATION_ID: &str = "several servers answer here: over Zenoh each mutation needs an operation_id, so that it takes effect once";
const NEEDS_UID: &str = "several servers answer here: over Zenoh a deletion needs the uid of its index, so that it deletes no later index of the name";

/// Calls `verb` and returns its answer in the form of the request. `max_message_bytes` is the face's limit.
pub(crate) async fn dispatch(
    service: &Service,
    call: &Call,
    verb: Verb,
    request: &Request<'_>,
    max_message_bytes: usize,
) -> Result<Vec<u8>, Error> {
    macro_rules! answer {
        ($verb:ident, $decode:ident) => {
            request.encode(boxed(service.$verb(call, request.$decode()?)).await)
        };
    }
    // Several servers may take one query while links change, one of them late: only a mutation that takes effect once is
    // safe then. A late deletion is one if it names the uid.
    macro_rules! mutate {
        ($verb:ident, $request:ident) => {{
            let mutation: v1::$request = request.decode_for_index()?;
            if service.is_shared() && mutation.operation_id.is_empty() {
                return Err(invalid("operation_id", "REQUIRED", NEEDS_OPERATION_ID));
            }
            request.encode(boxed(service.$verb(call, mutation)).await)
        }};
    }
    request.check_growth(verb, service.limits())?;
    match verb {
        Verb::Knn => {
            let search = search(request, |it: &v1::KnnRequest| it.include).await?;
            request.encode(service.knn(call, search).await)
        }
        Verb::Query => {
            let search = search(request, |it: &v1::QueryRequest| it.include).await?;
            request.encode(service.query(call, search).await)
        }
        Verb::Insert => mutate!(insert, InsertRequest),
        Verb::Update => mutate!(update, UpdateRequest),
        Verb::Remove => mutate!(remove, RemoveRequest),
        Verb::Session => mutate!(open_session, OpenSessionRequest),
        Verb::Write => answer!(write, decode_for_index),
        Verb::Get => answer!(get, decode_for_index),
        Verb::Scan => answer!(scan_page, decode_for_index),
        Verb::Info => answer!(get_index, decode_for_index),
        Verb::Log => answer!(log, decode_for_index),
        Verb::Server => {
            let described = service.get_server(call, request.decode()?, max_message_bytes);
            request.encode(boxed(described).await)
        }
        Verb::Create => answer!(create_index, decode),
        Verb::List => {
            let listed = boxed(service.list_indexes(call, request.decode()?)).await;
            request.encode(listed.map(status::listing))
        }
        Verb::Delete => {
            let deletion: v1::DeleteIndexRequest = request.decode()?;
            if service.is_shared() && deletion.uid.is_empty() {
                return Err(invalid("uid", "REQUIRED", NEEDS_UID));
            }
            request.encode(boxed(service.delete_index(call, deletion)).await)
        }
    }
}

/// Decodes a request for neighbours. One with payloads may read a disk: it yields first, which moves it off the
/// thread that reads a link of Zenoh.
async fn search<R>(
    request: &Request<'_>,
    include: fn(&R) -> Option<v1::Include>,
) -> Result<R, Error>
where
    R: Name + Default + observe::Request,
{
    let request = request.decode_for_index()?;
    if include(&request).is_some_and(|include| include.with_payloads) {
        tokio::task::yield_now().await;
    }
    Ok(request)
}

/// Boxes the future of every verb but the searches: a search's future is moved often and must stay small.
fn boxed<F: Future>(answering: F) -> Pin<Box<F>> {
    Box::pin(answering)
}
