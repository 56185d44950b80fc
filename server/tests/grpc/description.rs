//! A server tells what it is and what it allows, as it was set.

use wayfold_proto::v1;
use wayfold_server::log::Durability;

use crate::harness::TestServer;

async fn described(server: &TestServer) -> v1::GetServerResponse {
    let answer = server.indices().get_server(v1::GetServerRequest {}).await;
    answer.unwrap().into_inner()
}

#[tokio::test]
async fn it_names_its_version_and_its_limits() {
    let server = TestServer::start(|config| {
        config.limits.max_rows_per_call = 11;
        config.limits.max_ids_per_call = 12;
        config.limits.max_k = 13;
        config.limits.max_answer_bytes = 14_000;
        config.limits.max_indexes = 15;
        config.limits.max_reserved_ids = 16;
        config.grpc.max_message_bytes = 16_000;
        config.zenoh.max_message_bytes = 17_000;
    })
    .await;
    let answer = described(&server).await;
    assert_eq!(answer.version, env!("CARGO_PKG_VERSION"));
    assert_eq!(answer.durability(), v1::Durability::Memory);
    let expected = v1::Limits {
        max_rows_per_call: 11,
        max_ids_per_call: 12,
        max_k: 13,
        max_request_bytes: 16_000,
        max_answer_bytes: 14_000,
        max_payload_bytes: 65_536,
        max_indexes: 15,
        max_reserved_ids: 16,
        max_changed_point_bytes: 64 * 1024 * 1024,
    };
    assert_eq!(answer.limits, Some(expected));
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn it_names_what_a_mutation_survives() {
    for (durability, expected) in [
        (Durability::Fsync, v1::Durability::Fsync),
        (Durability::Os, v1::Durability::Os),
        (Durability::None, v1::Durability::None),
    ] {
        let directory = tempfile::tempdir().unwrap();
        let server = TestServer::start(|config| {
            config.data.dir = directory.path().to_str().unwrap().into();
            config.data.durability = durability;
        })
        .await;
        assert_eq!(described(&server).await.durability(), expected);
        server.stop().await.unwrap().unwrap();
    }
}
