//! The health of a server, by `grpc.health.v1`.

use tonic_health::pb::{
    HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient,
};

use super::{Client, within};
use crate::{Error, net::connections::Connection};

impl Client {
    /// Returns true if the server serves calls, and false while it starts or stops, or its store cannot be read.
    ///
    /// # Errors
    /// Those of every call.
    pub async fn is_serving(&self) -> Result<bool, Error> {
        let check = |connection: Connection, remaining| {
            // The empty name is the server as a whole.
            let request = within(remaining, HealthCheckRequest::default());
            let mut stub = HealthClient::new(connection.channel());
            async move { stub.check(request).await }
        };
        let answer = self.call("health", self.timeout(), check).await?;
        Ok(answer.status() == ServingStatus::Serving)
    }
}
