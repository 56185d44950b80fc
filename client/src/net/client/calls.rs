//! Calls, with retries at the same server or at another one.

use std::time::Duration;

use tokio::time::{Instant, timeout_at};

use super::Client;
use crate::{
    Error,
    net::{call::Call, connections::Connection},
};

impl Client {
    /// The longest time that this attempt of a call waits for its server to reach a revision. With several
    /// servers, the first attempt at each is bounded. Later ones, and the last, wait to the end.
    pub(crate) fn patience(&self, timeout: Duration, attempt: usize) -> Duration {
        let most = usize::try_from(self.settings.retry.attempts).unwrap_or(usize::MAX);
        match attempt < most && attempt <= self.connections.len() {
            true => self.connections.patience(timeout),
            false => Duration::MAX,
        }
    }

    /// Makes a call with one answer, with retries.
    pub(crate) async fn send<C: Call>(
        &self,
        timeout: Duration,
        request: &C,
    ) -> Result<C::Answer, Error> {
        let attempt =
            |connection, remaining| C::send(connection, within(remaining, request.clone()));
        self.call(C::NAME, timeout, attempt).await
    }

    /// Makes a call, with retries; each attempt gets the time that is left.
    pub(crate) async fn call<A, F, Fut>(
        &self,
        call: &'static str,
        timeout: Duration,
        attempt: F,
    ) -> Result<A, Error>
    where
        F: FnMut(Connection, Duration) -> Fut,
        Fut: Future<Output = Result<tonic::Response<A>, tonic::Status>>,
    {
        let deadline = Instant::now() + timeout;
        let answer = self.call_at(call, timeout, deadline, attempt).await;
        answer.map(|(answer, _)| answer)
    }

    /// Acts like [`Client::call`] until `deadline`, and returns the connection that the answer came on. Errors name
    /// `timeout`.
    pub(crate) async fn call_at<A, F, Fut>(
        &self,
        call: &'static str,
        timeout: Duration,
        deadline: Instant,
        mut attempt: F,
    ) -> Result<(A, Connection), Error>
    where
        F: FnMut(Connection, Duration) -> Fut,
        Fut: Future<Output = Result<tonic::Response<A>, tonic::Status>>,
    {
        let attempt = || {
            let connection = self.connection();
            let began = Instant::now();
            let remaining = deadline.saturating_duration_since(began);
            let sent = attempt(connection.clone(), remaining);
            async move {
                let error = match timeout_at(deadline, sent).await {
                    Ok(Ok(response)) => {
                        self.connections.answered(&connection);
                        return Ok((response.into_inner(), connection));
                    }
                    Ok(Err(status)) => Error::from_status(call, connection.uri(), timeout, status),
                    Err(_) => Error::timeout(call, timeout),
                };
                self.connections
                    .failed(&connection, &error, began.elapsed());
                Err(match self.connections.are_several() {
                    // Another server may accept the certificate.
                    true => error,
                    false => error.or_handshake(),
                })
            }
        };
        let answer = self.settings.retry.run(deadline, attempt).await;
        if let Err(error) = &answer {
            let mut known = self.known_limits();
            *known = known.filter(|limits| limits.lowered(error).is_none());
        }
        answer
    }
}

/// A request that the server gives up after `remaining`.
pub(crate) fn within<Q>(remaining: Duration, message: Q) -> tonic::Request<Q> {
    let mut request = tonic::Request::new(message);
    request.set_timeout(remaining);
    request
}
