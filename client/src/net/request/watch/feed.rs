//! The messages of a watch over gRPC.

use std::time::Duration;

use futures_util::{StreamExt, stream};
use tonic::Streaming;
use wayfold_proto::v1;

use super::{CALL, Messages};
use crate::{Error, IndexHandle, net::connections::Connection};

struct Feed {
    index: IndexHandle,
    connection: Connection,
    messages: Streaming<v1::WatchResponse>,
}

/// The messages of a server, until the client leaves it.
pub(super) fn messages(
    index: IndexHandle,
    connection: Connection,
    messages: Streaming<v1::WatchResponse>,
) -> Messages {
    let feed = Feed {
        index,
        connection,
        messages,
    };
    Box::pin(stream::unfold(feed, Feed::next))
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
                    source: "the client has gone to another server".into(),
                };
                return Some((Err(elsewhere), self));
            }
        };
        let named = match received {
            Ok(message) => {
                let named = self.index.answered(CALL, message.revision.clone());
                named.map(|_| message)
            }
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
