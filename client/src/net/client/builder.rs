//! The settings of a connection, and the attempts to make it.

use std::{error::Error as Cause, iter, sync::Arc, time::Duration};

use tokio::time::{Instant, timeout_at};
use tonic::{
    ConnectError, Status,
    transport::{Channel, Endpoint},
};
use tonic_health::pb::{HealthCheckRequest, health_client::HealthClient};

use super::Client;
use crate::{
    Credentials, Error, RetryPolicy,
    error::root_cause,
    net::{
        connections::{Connection, Connections, MAX_SILENCE},
        request::MAX_WAIT,
    },
};

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
        self.timeout = timeout.min(MAX_WAIT);
        self
    }

    /// The most bytes of one answer that the client accepts: 4 MiB unless set. It divides reads to keep to this and to
    /// the server's own limit. Parts of snapshots, watches, and scans with payloads may have 1 MiB and one
    /// payload, whatever is set here.
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
    /// `uri` may name several servers that share their indices, with commas between them: the client uses the first
    /// that answers, and goes on at the next one when that is unavailable. Reads still see no older revision of an index
    /// than the client has seen before, and a [`Watch`](crate::Watch) continues after the last mutation that it reported.
    ///
    /// # Errors
    /// [`Error::Address`]; [`Error::Argument`]: a token that is none; [`Error::Handshake`] if the only server and this
    /// client do not accept each other's certificates; or [`Error::Connection`] if no attempt reaches a server within the
    /// timeout.
    pub async fn connect(self, uri: &str) -> Result<Client, Error> {
        let bearer = self.credentials.bearer()?;
        let endpoints = self.endpoints(uri)?;
        let uris: Vec<&str> = endpoints.iter().map(|(uri, _)| &**uri).collect();
        let uri: Arc<str> = uris.join(",").into();
        let deadline = Instant::now() + self.timeout;
        let connect = || self.connect_first(&uri, &endpoints, deadline);
        let connected = self.retry.run(deadline, connect).await;
        let (first, channel) = connected.map_err(|error| match error {
            // The attempt before the timeout knows why there was no connection.
            Error::Timeout {
                earlier: Some(earlier),
                ..
            } => *earlier,
            Error::Timeout { .. } => unreachable(&uri, "no answer in time".into()),
            other => other,
        })?;
        let mut first_channel = Some(channel);
        let connections = endpoints
            .into_iter()
            .enumerate()
            .map(|(number, (uri, endpoint))| {
                let connected = first_channel.take_if(|_| number == first);
                let channel = connected.unwrap_or_else(|| endpoint.connect_lazy());
                Connection::new(uri, (channel, bearer.clone()), self.max_message_bytes)
            });
        Ok(Client {
            connections: Arc::new(Connections::new(connections.collect(), first)),
            uri,
            settings: self,
            limits: Arc::default(),
            newest: Arc::default(),
        })
    }

    /// The endpoints that `uri` names, and their addresses as the client shows them.
    fn endpoints(&self, uri: &str) -> Result<Vec<(Arc<str>, Endpoint)>, Error> {
        let uris: Vec<&str> = uri.split(',').collect();
        // The keep-alive lets a waiting stream notice that its peer is gone.
        let (connect, interval, silence) = match uris.len() {
            1 => (self.timeout, 10, Duration::from_secs(20)),
            // One that is silent leaves time for the others.
            servers => (
                MAX_SILENCE.min(self.timeout / u32::try_from(servers).unwrap_or(u32::MAX)),
                5,
                MAX_SILENCE,
            ),
        };
        let endpoints = uris.into_iter().map(|uri| {
            let endpoint = endpoint(uri, &self.credentials)?
                .tcp_nodelay(true)
                .connect_timeout(connect)
                .http2_keep_alive_interval(Duration::from_secs(interval))
                .keep_alive_timeout(silence)
                .initial_connection_window_size(MAX_UNREAD_BYTES);
            let uri = endpoint.uri().to_string();
            Ok((uri.trim_end_matches('/').into(), endpoint))
        });
        endpoints.collect()
    }

    /// Connects to the first server that answers, and returns its number.
    async fn connect_first(
        &self,
        uri: &str,
        endpoints: &[(Arc<str>, Endpoint)],
        deadline: Instant,
    ) -> Result<(usize, Channel), Error> {
        let mut failures = Vec::new();
        for (number, (server, endpoint)) in endpoints.iter().enumerate() {
            let longest = endpoint.get_connect_timeout().unwrap_or(self.timeout);
            let until = deadline.min(Instant::now() + longest);
            let connected = timeout_at(until, self.connect_to(server, endpoint)).await;
            let why = match connected {
                Ok(Ok(channel)) => return Ok((number, channel)),
                Ok(Err(error)) if endpoints.len() == 1 => return Err(error),
                Err(_) if failures.is_empty() && until == deadline => {
                    return Err(Error::timeout(CALL, self.timeout));
                }
                Ok(Err(error)) => root_cause(&error),
                Err(_) => "no answer in time".to_owned(),
            };
            failures.push(format!("{server}: {why}"));
        }
        Err(unreachable(uri, failures.join("; ").into()))
    }

    /// Connects to one server. Under TLS 1.3 a server refuses the client's certificate after the handshake has succeeded
    /// for the client, so a client with a certificate waits for a first answer too.
    async fn connect_to(&self, uri: &str, endpoint: &Endpoint) -> Result<Channel, Error> {
        let has_certificate = self.credentials.has_client_certificate();
        let connect = async {
            let channel = endpoint.connect().await?;
            if has_certificate && first_answer(channel.clone()).await.is_err() {
                // One connection may be cut by chance, and the channel makes another.
                first_answer(channel.clone()).await?;
            }
            Ok(channel)
        };
        let connected = connect.await;
        connected.map_err(|error: Box<dyn Cause + Send + Sync>| {
            let mut problem = root_cause(&*error);
            // Any failure before the end of the handshake, also of a reconnect, is a `ConnectError`.
            let has_tls = !causes(&*error).any(|cause| cause.is::<ConnectError>());
            if has_certificate && has_tls {
                problem.push_str("; the server may have refused the client's certificate");
            } else if !failed_handshake(&*error) {
                return unreachable(uri, error);
            }
            Error::Handshake {
                uri: uri.to_owned(),
                problem,
            }
        })
    }
}

/// Waits until the server answers a call, which may also be a refusal.
async fn first_answer(channel: Channel) -> Result<(), Status> {
    let mut stub = HealthClient::new(channel);
    match stub.check(HealthCheckRequest::default()).await {
        // The status of an answer has no source.
        Err(status) if status.source().is_some() => Err(status),
        _ => Ok(()),
    }
}

const CALL: &str = "connect";

/// A connection holds at most this many bytes of unread answers. Each stream holds up to 2 MiB, so 63 unread streams do
/// not stop the other calls.
const MAX_UNREAD_BYTES: u32 = 128 * 1024 * 1024;

/// True if TLS refused what the server sent: rustls reports nothing else as invalid data.
fn failed_handshake(error: &(dyn Cause + 'static)) -> bool {
    causes(error)
        .filter_map(|error| error.downcast_ref::<std::io::Error>())
        .any(|error| error.kind() == std::io::ErrorKind::InvalidData)
}

/// The error, then its source, and so on.
fn causes<'e>(error: &'e (dyn Cause + 'static)) -> impl Iterator<Item = &'e (dyn Cause + 'static)> {
    iter::successors(Some(error), |&error| error.source())
}

fn unreachable(uri: &str, source: Box<dyn Cause + Send + Sync>) -> Error {
    Error::Connection {
        call: CALL,
        uri: uri.to_owned(),
        source,
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
    let authority = endpoint.uri().authority().map_or("", |it| it.as_str());
    // The address of an IPv6 host has colons within brackets.
    let after_host = authority.rsplit([']', '@']).next().unwrap_or_default();
    if after_host.contains(':') && endpoint.uri().port_u16().is_none() {
        return Err(refused("its port is no number from 0 to 65535"));
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
    endpoint.map_err(|error| {
        let problem = root_cause(&error);
        refused(&format!("the certificates cannot be used: {problem}"))
    })
}
