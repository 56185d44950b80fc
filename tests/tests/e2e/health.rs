//! The health of a server over gRPC.

use tonic::transport::Channel;
use tonic_health::pb::{
    HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient,
};

/// The status under a name.
pub(crate) async fn health(uri: &str, name: &str) -> ServingStatus {
    let channel = Channel::from_shared(uri.to_owned()).unwrap();
    let mut client = HealthClient::new(channel.connect().await.unwrap());
    let service = name.to_owned();
    let answer = client.check(HealthCheckRequest { service }).await;
    answer.unwrap().into_inner().status()
}
