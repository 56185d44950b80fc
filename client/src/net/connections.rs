//! The connections of a client: one for each server, and the one in use.

use std::{sync::Arc, time::Duration};

use parking_lot::Mutex;
use tokio::{sync::watch, time::Instant};
use tonic::{Code, Status, service::interceptor::InterceptedService, transport::Channel};
use wayfold_proto::v1::{
    index_service_client::IndexServiceClient, point_service_client::PointServiceClient,
};

use super::credentials::Bearer;
use crate::Error;

/// The longest time for which a client with several servers waits for one that is silent: for its connection, and for
/// the answer to a keep-alive. If no call was answered for longer, the next one goes elsewhere.
pub(crate) const MAX_SILENCE: Duration = Duration::from_secs(5);

/// A healthy server answers within this time, so a shorter wait does not show that a server is silent.
const MIN_PATIENCE: Duration = Duration::from_secs(1);

/// A connection whose calls have the client's token.
type Transport = InterceptedService<Channel, Bearer>;

pub(crate) type IndexStub = IndexServiceClient<Transport>;

/// The stub of the calls about points.
pub(crate) type PointStub = PointServiceClient<Transport>;

/// A connection to one server. The next call restores it when it is broken.
#[derive(Clone, Debug)]
pub(crate) struct Connection {
    /// The number of times that the client had gone to the next server when this connection was taken, counted from the
    /// first server.
    turn: usize,
    uri: Arc<str>,
    channel: Transport,
    max_message_bytes: usize,
}

/// The connections to servers that serve the same indices.
#[derive(Debug)]
pub(crate) struct Connections {
    /// At least one.
    all: Vec<Connection>,
    /// The turn of the connection in use: `turn` modulo their number is its place in `all`.
    turn: watch::Sender<usize>,
    /// The begin of the first call that was without an answer since the last answer of the connection in use.
    silent_since: Mutex<Option<Instant>>,
}

impl Connection {
    pub(crate) fn new(
        uri: Arc<str>,
        (channel, bearer): (Channel, Bearer),
        max_message_bytes: usize,
    ) -> Connection {
        Connection {
            turn: 0,
            uri,
            channel: InterceptedService::new(channel, bearer),
            max_message_bytes,
        }
    }

    /// The server's address.
    pub(crate) fn uri(&self) -> &Arc<str> {
        &self.uri
    }

    pub(crate) fn turn(&self) -> usize {
        self.turn
    }

    pub(crate) fn channel(&self) -> Transport {
        self.channel.clone()
    }

    /// The stub of the calls about whole indices.
    pub(crate) fn indexes(&self) -> IndexStub {
        IndexServiceClient::new(self.channel()).max_decoding_message_size(self.max_message_bytes)
    }

    /// The stub of the calls about points.
    pub(crate) fn points(&self) -> PointStub {
        PointServiceClient::new(self.channel()).max_decoding_message_size(self.max_message_bytes)
    }
}

impl Connections {
    /// These connections; the first calls use the one at `first`.
    pub(crate) fn new(all: Vec<Connection>, first: usize) -> Connections {
        let turn = watch::Sender::new(first);
        Connections {
            all,
            turn,
            silent_since: Mutex::default(),
        }
    }

    pub(crate) fn are_several(&self) -> bool {
        self.all.len() > 1
    }

    /// The number of servers.
    pub(crate) fn len(&self) -> usize {
        self.all.len()
    }

    /// The longest time of a call of `timeout` that the client waits for one server. With several servers it is the part of
    /// each, but at least [`MIN_PATIENCE`] and at most [`MAX_SILENCE`].
    pub(crate) fn patience(&self, timeout: Duration) -> Duration {
        if !self.are_several() {
            return timeout;
        }
        let servers = u32::try_from(self.all.len()).unwrap_or(u32::MAX);
        (timeout / servers).clamp(MIN_PATIENCE, MAX_SILENCE)
    }

    /// Makes an attempt of a call of `timeout`. One of several servers may be silent for [`Connections::patience`] only.
    pub(crate) async fn patiently<T>(
        &self,
        timeout: Duration,
        attempt: impl Future<Output = Result<T, Status>>,
    ) -> Result<T, Status> {
        if !self.are_several() {
            return attempt.await;
        }
        let answered = tokio::time::timeout(self.patience(timeout), attempt).await;
        answered.unwrap_or_else(|silent| {
            let mut status = Status::unavailable("the server is silent");
            status.set_source(Arc::new(silent));
            Err(status)
        })
    }

    /// The connection in use.
    pub(crate) fn current(&self) -> Connection {
        let turn = *self.turn.borrow();
        Connection {
            turn,
            ..self.all[turn % self.all.len()].clone()
        }
    }

    /// A call on this connection failed after a time. If its server may be of no use now, the next calls go to the
    /// next server.
    pub(crate) fn failed(&self, connection: &Connection, error: &Error, after: Duration) {
        match error.code() {
            Code::Unavailable => self.leave(connection),
            // It stands still, or the revision that the call waits for does not reach it.
            Code::DeadlineExceeded if connection.turn == *self.turn.borrow() => {
                let now = Instant::now();
                let began = now.checked_sub(after).unwrap_or(now);
                let mut silent_since = self.silent_since.lock();
                let since = silent_since.map_or(began, |since| since.min(began));
                *silent_since = Some(since);
                drop(silent_since);
                if now - since >= MAX_SILENCE {
                    self.leave(connection);
                }
            }
            _ => {}
        }
    }

    /// A server has answered a call on this connection.
    pub(crate) fn answered(&self, connection: &Connection) {
        if connection.turn == *self.turn.borrow() {
            *self.silent_since.lock() = None;
        }
    }

    /// Lets the next calls go to the next server, unless this connection is no longer in use.
    pub(crate) fn leave(&self, connection: &Connection) {
        self.turn.send_if_modified(|turn| {
            let leaves = self.are_several() && *turn == connection.turn;
            *turn += usize::from(leaves);
            if leaves {
                *self.silent_since.lock() = None;
            }
            leaves
        });
    }

    /// Returns once this connection is not in use any more.
    pub(crate) async fn left(&self, connection: &Connection) {
        let mut turn = self.turn.subscribe();
        // The sender is `self`, so there is no error.
        let _ = turn.wait_for(|turn| *turn != connection.turn).await;
    }
}

#[cfg(test)]
mod tests {
    use tokio::time::advance;
    use tonic::transport::Endpoint;

    use super::*;
    use crate::Credentials;

    /// Connections that are never made.
    fn connections(count: usize) -> Connections {
        let bearer = Credentials::new().bearer().unwrap();
        let connection = |number| {
            let channel = Endpoint::from_static("http://127.0.0.1:0").connect_lazy();
            let uri = format!("server {number}");
            Connection::new(uri.into(), (channel, bearer.clone()), 0)
        };
        Connections::new((0..count).map(connection).collect(), 0)
    }

    #[tokio::test]
    async fn calls_that_fail_together_move_the_client_once() {
        let connections = connections(3);
        let first = connections.current();
        let calls = [first.clone(), first.clone()];
        for call in &calls {
            connections.leave(call);
            connections.left(call).await;
            assert_eq!(&**connections.current().uri(), "server 1");
        }
        for next in ["server 2", "server 0", "server 1"] {
            connections.leave(&connections.current());
            assert_eq!(&**connections.current().uri(), next);
        }
        // A call that began before the client came round again.
        connections.leave(&first);
        assert_eq!(&**connections.current().uri(), "server 1");
    }

    #[tokio::test(start_paused = true)]
    async fn a_server_is_left_for_a_long_silence_and_not_for_short_timeouts() {
        let connections = connections(2);
        let first = connections.current();
        let silence = Error::timeout("knn", MAX_SILENCE);
        let fail =
            |connection: &Connection| connections.failed(connection, &silence, MAX_SILENCE / 2);
        // Many calls at once wait for the same time.
        for _ in 0..50 {
            fail(&first);
        }
        advance(MAX_SILENCE / 4).await;
        connections.answered(&first);
        advance(MAX_SILENCE / 4).await;
        fail(&first);
        assert_eq!(connections.current().turn(), first.turn());
        advance(MAX_SILENCE / 2).await;
        fail(&first);
        let second = connections.current();
        assert_ne!(second.turn(), first.turn());
        // A call that began before counts for the server that it asked.
        connections.failed(&first, &silence, 2 * MAX_SILENCE);
        assert_eq!(connections.current().turn(), second.turn());
        connections.failed(&second, &silence, MAX_SILENCE);
        assert_ne!(connections.current().turn(), second.turn());
    }

    #[tokio::test]
    async fn one_of_several_servers_has_its_part_of_the_time() {
        let patience = |servers, seconds| {
            let timeout = Duration::from_secs(seconds);
            connections(servers).patience(timeout).as_secs()
        };
        assert_eq!([60, 6, 1].map(|seconds| patience(3, seconds)), [5, 2, 1]);
        assert_eq!(patience(1, 60), 60);
    }

    #[tokio::test]
    async fn a_single_server_is_never_left() {
        let connections = connections(1);
        let only = connections.current();
        connections.leave(&only);
        assert_eq!(connections.current().turn(), only.turn());
    }
}
