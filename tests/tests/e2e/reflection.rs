//! Health and reflection, as tools that know nothing of us find them.

use tokio_stream::iter;
use tonic::{Code, transport::Channel};
use tonic_health::pb::{
    HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient,
};
use wayfold_tests::server;

#[tokio::test]
async fn each_service_is_healthy_and_no_other_is_known() {
    let server = server!();
    let channel = Channel::from_shared(server.uri().to_owned()).unwrap();
    let mut health = HealthClient::new(channel.connect().await.unwrap());
    for service in ["", "wayfold.v1.IndexService", "wayfold.v1.PointService"] {
        let request = HealthCheckRequest {
            service: service.into(),
        };
        let status = health.check(request).await.unwrap().into_inner().status();
        assert_eq!(status, ServingStatus::Serving, "{service}");
    }
    let request = HealthCheckRequest {
        service: "wayfold.v1.NoService".into(),
    };
    let status = health.check(request).await.unwrap_err();
    assert_eq!(status.code(), Code::NotFound);
}

/// The two versions of the protocol are the same messages in two packages.
macro_rules! reflection_test {
    ($name:ident, $version:ident) => {
        #[tokio::test]
        async fn $name() {
            use tonic_reflection::pb::$version::{
                ServerReflectionRequest,
                server_reflection_client::ServerReflectionClient,
                server_reflection_request::MessageRequest::{FileContainingSymbol, ListServices},
                server_reflection_response::MessageResponse,
            };
            let server = server!();
            let channel = Channel::from_shared(server.uri().to_owned()).unwrap();
            let mut client = ServerReflectionClient::new(channel.connect().await.unwrap());
            let asked = [
                ListServices(String::new()),
                FileContainingSymbol("wayfold.v1.KnnRequest".into()),
            ];
            let asked = asked.map(|request| ServerReflectionRequest {
                host: String::new(),
                message_request: Some(request),
            });
            let answers = client.server_reflection_info(iter(asked)).await;
            let mut answers = answers.unwrap().into_inner();
            let services = answers.message().await.unwrap().unwrap().message_response;
            let Some(MessageResponse::ListServicesResponse(services)) = services else {
                panic!("{services:?}");
            };
            let names: Vec<_> = services.service.iter().map(|s| s.name.as_str()).collect();
            assert!(names.contains(&"wayfold.v1.IndexService"), "{names:?}");
            assert!(names.contains(&"wayfold.v1.PointService"), "{names:?}");
            let file = answers.message().await.unwrap().unwrap().message_response;
            let Some(MessageResponse::FileDescriptorResponse(file)) = file else {
                panic!("{file:?}");
            };
            assert!(!file.file_descriptor_proto.is_empty());
        }
    };
}

reflection_test!(reflection_v1, v1);
reflection_test!(reflection_v1alpha, v1alpha);
