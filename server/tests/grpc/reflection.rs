//! Generic clients discover the server's methods by both versions of the reflection protocol.

use crate::harness::TestServer;
use tokio_stream::{StreamExt, once};

/// The same conversation in one of the two versions, which differ in the names of their types only.
macro_rules! converse {
    ($version:ident, $channel:expr, $request:expr) => {{
        use tonic_reflection::pb::$version::{
            ServerReflectionRequest, server_reflection_client::ServerReflectionClient,
            server_reflection_request::MessageRequest, server_reflection_response::MessageResponse,
        };
        let request = ServerReflectionRequest {
            host: String::new(),
            message_request: Some(MessageRequest::from($request)),
        };
        let mut client = ServerReflectionClient::new($channel);
        let answers = client.server_reflection_info(once(request)).await.unwrap();
        let answer = answers.into_inner().next().await.unwrap().unwrap();
        match answer.message_response.unwrap() {
            MessageResponse::ListServicesResponse(list) => list
                .service
                .into_iter()
                .map(|service| service.name)
                .collect(),
            MessageResponse::FileDescriptorResponse(files) => files
                .file_descriptor_proto
                .iter()
                .map(|file| {
                    let file =
                        <prost_types::FileDescriptorProto as prost::Message>::decode(&**file);
                    file.unwrap().name.unwrap()
                })
                .collect::<Vec<String>>(),
            other => panic!("{other:?}"),
        }
    }};
}

macro_rules! conversation {
    ($version:ident, $own_name:literal) => {
        #[tokio::test]
        async fn $version() {
            let server = TestServer::start(|_| ()).await;
            let channel = || server.channel.clone();
            let mut services = converse!(
                $version,
                channel(),
                MessageRequest::ListServices(String::new())
            );
            services.sort();
            assert_eq!(
                services,
                [
                    "grpc.health.v1.Health",
                    $own_name,
                    "wayfold.v1.IndexService",
                    "wayfold.v1.PointService"
                ]
            );
            for (symbol, file) in [
                ("wayfold.v1.PointService", "wayfold/v1/point_service.proto"),
                (
                    "wayfold.v1.PointService.Knn",
                    "wayfold/v1/point_service.proto",
                ),
                ("wayfold.v1.KnnRequest", "wayfold/v1/point_service.proto"),
                ("wayfold.v1.Space", "wayfold/v1/space.proto"),
                ("google.rpc.BadRequest", "error_details.proto"),
            ] {
                let files = converse!(
                    $version,
                    channel(),
                    MessageRequest::FileContainingSymbol(symbol.into())
                );
                assert!(files.contains(&file.to_owned()), "{symbol}: {files:?}");
            }
            server.stop().await.unwrap().unwrap();
        }
    };
}

conversation!(v1, "grpc.reflection.v1.ServerReflection");
conversation!(v1alpha, "grpc.reflection.v1alpha.ServerReflection");
