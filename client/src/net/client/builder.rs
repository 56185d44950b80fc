//! The settings of a connection, and the attempts to make it.

use std::{sync::Arc, time::Duration};

use tokio::time::{Instant, timeout_at};
use tonic::{service::interceptor::InterceptedService, transport::Endpoint};

use super::Client;
use crate::{Credentials, Error, RetryPolicy, net::request::LONGEST_WAIT};

/// Settings of a [`Client`].
#[derive(Clone, Debug)]
pub struct ClientBuilder {
    pub(super) timeout: Duration,
    pub(super) max_message_bytes: usize,
    pub(super) retry: RetryPolicy,
    credentials: Credentials,
}

impl Default for ClientBuilder {
    fn default() -> ClientBuilder {
        ClientBuilder {
            timeout: Duration::from_secs(30),
            max_message_bytes: 4 * 1024 * 1024,
            retry: RetryPolicy::default(),
            credentials: Credentials::default(),
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

    /// The certificates and the token of the connection: none unless set.
    pub fn credentials(mut self, credentials: Credentials) -> ClientBuilder {
        self.credentials = credentials;
        self
    }

    /// Connects to the server at `uri`: `https://HOST:PORT`, which needs the certificate of an authority,
    /// `http://HOST:PORT`, or just `HOST:PORT`.
    ///
    /// # Errors
    /// [`Error::Address`]; [`Error::Argument`]: a token that is none; or [`Error::Connection`] if no attempt reaches a
    /// server within the timeout.
    pub async fn connect(self, uri: &str) -> Result<Client, Error> {
        const CALL: &str = "connect";
        let bearer = self.credentials.bearer()?;
        let endpoint = endpoint(uri, &self.credentials)?
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
            channel: InterceptedService::new(channel, bearer),
            uri,
            settings: self,
            limits: Arc::default(),
        })
    }
}

/// The endpoint at `uri`, whose scheme may be left out.
fn endpoint(uri: &str, credentials: &Credentials) -> Result<Endpoint, Error> {
    let refused = |problem: &str| Error::Address {
        uri: uri.to_owned(),
        problem: problem.to_owned(),
    };
    let full = match uri.split_once("://") {
        None if credentials.wants_tls() => format!("https://{uri}"),
        None => format!("http://{uri}"),
        Some(("http", _)) if credentials.wants_tls() => {
            return Err(refused(
                "it speaks http, and certificates need https: https://HOST:PORT",
            ));
        }
        Some(("http" | "https", _)) => uri.to_owned(),
        Some((scheme, _)) => {
            return Err(refused(&format!(
                "it speaks {scheme}, and this client only http and https"
            )));
        }
    };
    let endpoint = Endpoint::from_shared(full).map_err(|error| refused(&error.to_string()))?;
    if let None | Some("") = endpoint.uri().host() {
        return Err(refused("it names no host"));
    }
    if endpoint.uri().scheme_str() != Some("https") {
        return Ok(endpoint);
    }
    let Some(tls) = credentials.tls() else {
        return Err(refused(
            "https needs the certificate of the authority that certifies the server",
        ));
    };
    let endpoint = endpoint.tls_config(tls);
    endpoint.map_err(|error| refused(&format!("its certificates cannot be used: {error}")))
}
