//! Translates a verb to a call of the service, and its answer to a payload. No policy is here.

use std::pin::Pin;

use super::{
    message::{Named, SearchRequest},
    request::Request,
    verb::{IndexVerb, PointVerb, Verb},
};
use crate::{
    service::{Call, Error, Service},
    status,
};

/// Calls `verb` and returns its answer in the form of the request. `max_message_bytes` is the face's limit.
pub(super) async fn dispatch(
    service: &Service,
    call: &Call,
    verb: Verb,
    request: &Request<'_>,
    max_message_bytes: usize,
) -> Result<Vec<u8>, Error> {
    match verb {
        Verb::OfIndex(verb) => match verb {
            PointVerb::Knn => encoded(request, service.knn(call, search(request).await?).await),
            PointVerb::Query => encoded(request, service.query(call, search(request).await?).await),
            PointVerb::Insert => encoded(
                request,
                boxed(service.insert(call, request.decode_for_index()?)).await,
            ),
            PointVerb::Update => encoded(
                request,
                boxed(service.update(call, request.decode_for_index()?)).await,
            ),
            PointVerb::Remove => encoded(
                request,
                boxed(service.remove(call, request.decode_for_index()?)).await,
            ),
            PointVerb::Session => encoded(
                request,
                boxed(service.open_session(call, request.decode_for_index()?)).await,
            ),
            PointVerb::Write => encoded(
                request,
                boxed(service.write(call, request.decode_for_index()?)).await,
            ),
            PointVerb::Get => encoded(
                request,
                boxed(service.get(call, request.decode_for_index()?)).await,
            ),
            PointVerb::Scan => encoded(
                request,
                boxed(service.scan_page(call, request.decode_for_index()?)).await,
            ),
            PointVerb::Info => encoded(
                request,
                boxed(service.get_index(call, request.decode_for_index()?)).await,
            ),
            PointVerb::Log => encoded(
                request,
                boxed(service.log(call, request.decode_for_index()?)).await,
            ),
        },
        Verb::OfServer(verb) => match verb {
            IndexVerb::Server => {
                let described = service.get_server(call, request.decode()?, max_message_bytes);
                encoded(request, boxed(described).await)
            }
            IndexVerb::Create => encoded(
                request,
                boxed(service.create_index(call, request.decode()?)).await,
            ),
            IndexVerb::List => {
                let listed = boxed(service.list_indexes(call, request.decode()?)).await;
                encoded(request, listed.map(status::listing))
            }
            IndexVerb::Delete => encoded(
                request,
                boxed(service.delete_index(call, request.decode()?)).await,
            ),
        },
    }
}

/// Decodes a request for neighbours. One with payloads may read a disk: it yields first, which moves it off Zenoh's
/// thread.
async fn search<R: SearchRequest>(request: &Request<'_>) -> Result<R, Error> {
    let request: R = request.decode_for_index()?;
    if request.include().is_some_and(|include| include.payloads) {
        tokio::task::yield_now().await;
    }
    Ok(request)
}

/// Boxes the future of every verb but the searches: a search's future is moved often and must stay small.
fn boxed<F: Future>(answering: F) -> Pin<Box<F>> {
    Box::pin(answering)
}

fn encoded<M: Named>(request: &Request<'_>, answer: Result<M, Error>) -> Result<Vec<u8>, Error> {
    request.encode(&answer?)
}
