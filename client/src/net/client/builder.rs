//! The settings of a connection, and the attempts to make it.

use std::{sync::Arc, time::Duration};

use tokio::time::{Instant, timeout_at};
use tonic::transport::Endpoint;

use super::Client;
use crate::{Error, RetryPolicy, net::request::LONGEST_WAIT};

/// Settings of a [`Client`].
#[derive(Clone, Copy, Debug)]
pub struct ClientBuilder {
    pub(super) timeout: Duration,
    pub(super) max_message_bytes: usize,
    pub(super) retry: RetryPolicy,
}

impl Default for ClientBuilder {
    fn default() -> ClientBuilder {
        ClientBuilder {
            timeout: Duration::from_secs(30),
            max_message_bytes: 4 * 1024 * 1024,
            retry: RetryPolicy::default(),
        }
    }
}

impl ClientBuilder {
    /// The longest time of a call, attempts and pauses included: 30 s unless set. The server also stops work on the
    /// call then.
    pub fn timeout(mut self, timeout: Duration) -> ClientBuilder {
        self.timeout = timeout.min(LONGEST_WAIT);
        self
    }

    /// The most bytes of one answer that the client accepts: 4 MiB unless set. It divides reads to keep to this and to
    /// the server's own limit.
    pub fn max_message_bytes(mut self, bytes: usize) -> ClientBuilder {
        self.max_message_bytes = bytes;
        self
    }

    /// The policy by which the client retries a call that found no server.
    pub fn retry(mut self, policy: RetryPolicy) -> ClientBuilder {
        self.retry = policy;
        self
    }

    /// Connects to the server at `uri`, `http://HOST:PORT` or just `HOST:PORT`.
    ///
    /// # Errors
    /// [`Error::Address`], or [`Error::Connection`] if no attempt reaches a server within the timeout.
    pub async fn connect(self, uri: &str) -> Result<Client, Error> {
        const CALL: &str = "connect";
        let endpoint = endpoint(uri)?
            .tcp_nodelay(true)
            .connect_timeout(self.timeout)
            // The keep-alive lets a waiting stream notice that its peer is gone.
            .http2_keep_alive_interval(Duration::from_secs(10))
            .keep_alive_timeout(Duration::from_secs(20));
        let uri: Arc<str> = endpoint.uri().to_string().trim_end_matches('/').into();
        let deadline = Instant::now() + self.timeout;
        let unreachable = |source| Error::Connection {
            call: CALL,
            uri: uri.to_string(),
            source,
        };
        let connect = || async {
            let connected = timeout_at(deadline, endpoint.connect()).await;
            let connected = connected.map_err(|_| Error::timeout(CALL, self.timeout))?;
            connected.map_err(|error| unreachable(Box::new(error)))
        };
        let connected = self.retry.run(deadline, connect).await;
        let channel = connected.map_err(|error| match error {
            // The attempt before the timeout knows why there was no connection.
            Error::Timeout {
                earlier: Some(earlier),
                ..
            } => *earlier,
            Error::Timeout { .. } => unreachable("no answer in time".into()),
            other => other,
        })?;
        Ok(Client {
            channel,
            uri,
            settings: self,
            limits: Arc::default(),
        })
    }
}

/// The endpoint at `uri`, whose scheme may be left out.
fn endpoint(uri: &str) -> Result<Endpoint, Error> {
    let refused = |problem: &str| Error::Address {
        uri: uri.to_owned(),
        problem: problem.to_owned(),
    };
    let full = match uri.split_once("://") {
        None => format!("http://{uri}"),
        Some(("http", _)) => uri.to_owned(),
        Some((scheme, _)) => {
            return Err(refused(&format!(
                "it speaks {scheme}, and this client only http"
            )));
        }
    };
    let endpoint = Endpoint::from_shared(full).map_err(|error| refused(&error.to_string()))?;
    match endpoint.uri().host() {
        None | Some("") => Err(refused("it names no host")),
        Some(_) => Ok(endpoint),
    }
}
