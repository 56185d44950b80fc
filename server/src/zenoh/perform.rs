//! A verb becomes a call of the service, and its answer a payload. No policy is here.

use std::pin::Pin;

use super::{
    asked::Asked,
    message::{Named, SearchRequest},
    verb::{IndexVerb, PointVerb, Verb},
};
use crate::{
    service::{Call, Error, Service},
    status,
};

/// What `verb` answers to what is asked, in the form in which it is asked. `max_message_bytes` is the face's limit.
pub(super) async fn perform(
    service: &Service,
    call: &Call,
    verb: Verb,
    asked: &Asked<'_>,
    max_message_bytes: usize,
) -> Result<Vec<u8>, Error> {
    match verb {
        Verb::OfIndex(verb) => match verb {
            PointVerb::Knn => told(asked, service.knn(call, search(asked).await?).await),
            PointVerb::Query => told(asked, service.query(call, search(asked).await?).await),
            PointVerb::Insert => told(asked, apart(service.insert(call, asked.request()?)).await),
            PointVerb::Update => told(asked, apart(service.update(call, asked.request()?)).await),
            PointVerb::Remove => told(asked, apart(service.remove(call, asked.request()?)).await),
            PointVerb::Get => told(asked, apart(service.get(call, asked.request()?)).await),
            PointVerb::Info => told(
                asked,
                apart(service.get_index(call, asked.request()?)).await,
            ),
            PointVerb::Log => told(asked, apart(service.log(call, asked.request()?)).await),
        },
        Verb::OfServer(verb) => match verb {
            IndexVerb::Server => {
                let described = service.get_server(call, asked.of_server()?, max_message_bytes);
                told(asked, apart(described).await)
            }
            IndexVerb::Create => told(
                asked,
                apart(service.create_index(call, asked.of_server()?)).await,
            ),
            IndexVerb::List => {
                let listed = apart(service.list_indexes(call, asked.of_server()?)).await;
                told(asked, listed.map(status::listing))
            }
            IndexVerb::Delete => told(
                asked,
                apart(service.delete_index(call, asked.of_server()?)).await,
            ),
        },
    }
}

/// A request for neighbours. With payloads, which the store may have to read from a disk, it lets others on first: it is
/// no search then that could be answered where it arrived.
async fn search<R: SearchRequest>(asked: &Asked<'_>) -> Result<R, Error> {
    let request: R = asked.request()?;
    if request.include().is_some_and(|include| include.payloads) {
        tokio::task::yield_now().await;
    }
    Ok(request)
}

/// What answers anything but a search is kept apart: the answer to a search is to move about without the room that a
/// mutation needs.
fn apart<F: Future>(answering: F) -> Pin<Box<F>> {
    Box::pin(answering)
}

fn told<M: Named>(asked: &Asked<'_>, answer: Result<M, Error>) -> Result<Vec<u8>, Error> {
    asked.answer(&answer?)
}
