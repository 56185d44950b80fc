//! The messages of a watch over gRPC.

use std::time::Duration;

use futures_util::{StreamExt, stream};
use tonic::Streaming;
use wayfold_proto::v1;

use super::{CALL, Messages};
use crate::{Error, IndexHandle, net::connections::Connection};

/// The client has left a server that did not fail.
#[derive(Debug, thiserror::Error)]
#[error("the client has gone to another server")]
struct Moved;

/// True if the watch only follows its client to another server.
pub(super) fn has_moved(error: &Error) -> bool {
    matches!(error, Error::Connection { source, .. } if source.is::<Moved>())
}

struct Feed {
    index: IndexHandle,
    connection: Connection,
    messages: Streaming<v1::WatchResponse>,
}

/// The first message of a server, and those after it until the client leaves the server.
pub(super) fn messages(
    index: IndexHandle,
    connection: Connection,
    first: Option<v1::WatchResponse>,
    messages: Streaming<v1::WatchResponse>,
) -> Messages {
    let first = first.map(|first| named(&index, first));
    let feed = Feed {
        index,
        connection,
        messages,
    };
    Box::pin(stream::iter(first).chain(stream::unfold(feed, Feed::next)))
}

/// A message, whose revision the handle remembers.
fn named(index: &IndexHandle, message: v1::WatchResponse) -> Result<v1::WatchResponse, Error> {
    index.answered(CALL, message.revision.clone())?;
    Ok(message)
}

impl Feed {
    async fn next(mut self) -> Option<(Result<v1::WatchResponse, Error>, Feed)> {
        let connections = self.index.client().connections();
        let received = tokio::select! {
            biased;
            received = self.messages.next() => received?,
            () = connections.left(&self.connection) => {
                let elsewhere = Error::Connection {
                    call: CALL,
                    uri: self.connection.uri().to_string(),
                    source: Box::new(Moved),
                };
                return Some((Err(elsewhere), self));
            }
        };
        let named = match received {
            Ok(message) => named(&self.index, message),
            Err(status) => {
                let (uri, waited) = (self.connection.uri(), self.index.timeout());
                let error = Error::from_status(CALL, uri, waited, status);
                connections.failed(&self.connection, &error, Duration::ZERO);
                Err(error)
            }
        };
        Some((named, self))
    }
}
