//! Calls that do not reach the service: messages too large or malformed, and calls beyond the server's capacity.

use crate::{
    harness::{TestServer, column, insert, knn, reason, uid_of},
    raw::Raw,
};
use http::uri::PathAndQuery;
use tokio::sync::oneshot;
use tonic::{Code, Request, Status};
use tonic_health::pb::{HealthCheckRequest, health_check_response::ServingStatus};
use tonic_types::StatusExt;
use wayfold_proto::v1;

async fn send(server: &TestServer, rpc: &str, bytes: &[u8]) -> Result<Vec<u8>, Status> {
    let mut client = tonic::client::Grpc::new(server.channel.clone());
    client.ready().await.unwrap();
    let path: PathAndQuery = format!("/wayfold.v1.{rpc}").parse().unwrap();
    let request = Request::new(bytes.to_vec());
    let answer = client.unary(request, path, Raw).await?;
    Ok(answer.into_inner())
}

/// Field 1 as a varint, where every request has a string; a length that runs out of the message; a name that is not
/// UTF-8; a tag of no type; an endless varint.
const MALFORMED: [&[u8]; 5] = [
    &[0x08, 0x01],
    &[0x0a, 0x7f, b'x'],
    &[0x0a, 0x02, 0xff, 0xfe],
    &[0x0f],
    &[0xff; 16],
];

#[tokio::test]
async fn a_message_that_does_not_parse_is_an_invalid_argument() {
    let server = TestServer::start(|_| ()).await;
    for rpc in [
        "IndexService/CreateIndex",
        "IndexService/SnapshotIndex",
        "IndexService/RestoreIndex",
        "IndexService/VerifyIndex",
        "PointService/Insert",
        "PointService/Update",
        "PointService/Remove",
        "PointService/Get",
        "PointService/Knn",
        "PointService/Query",
        "PointService/Scan",
    ] {
        for bytes in MALFORMED {
            let status = send(&server, rpc, bytes).await.unwrap_err();
            let reason = reason(&status, Code::InvalidArgument);
            assert_eq!(reason, "MALFORMED_MESSAGE", "{rpc} {bytes:?}");
            let fields = status.get_details_bad_request().unwrap().field_violations;
            assert_eq!(fields[0].field, "request");
        }
    }
    // The connection still works.
    server.create_line("line").await;
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn the_refusal_of_a_large_message_names_the_limit() {
    let server = TestServer::start(|config| config.grpc.max_message_bytes = 100_000).await;
    let index = server.create_line("line").await;
    let mut points = server.points();
    let status = points.insert(insert("line", &vec![0.5; 20_000])).await;
    let status = status.unwrap_err();
    assert_eq!(reason(&status, Code::ResourceExhausted), "LIMIT_EXCEEDED");
    let text = "grpc.max_message_bytes = 100000";
    assert!(status.message().contains(text), "{status}");
    let quota = status.get_details_quota_failure().unwrap();
    assert_eq!(quota.violations[0].subject, "grpc.max_message_bytes");
    assert_eq!(quota.violations[0].quota_value, 100_000);

    let answer = points.insert(insert("line", &vec![0.5; 10_000])).await;
    let answer = answer.unwrap().into_inner();
    let revision = answer.revision.unwrap();
    assert_eq!((revision.number, revision.uid), (1, uid_of(&index)));
    server.stop().await.unwrap().unwrap();
}

/// A message without content takes two bytes as it is sent, and 32 to 50 once it is decoded.
#[tokio::test]
async fn requests_that_grow_by_decoding_are_refused_before_it() {
    let server = TestServer::start(|config| {
        config.limits.max_rows_per_call = 1000;
        config.limits.max_ids_per_call = 1000;
    });
    let server = server.await;
    for (rpc, payloads) in [
        ("PointService/Insert", 5),
        ("PointService/Update", 5),
        ("PointService/Write", 9),
    ] {
        let empty = [payloads << 3 | 2, 0].repeat(5000);
        let status = send(&server, rpc, &empty).await.unwrap_err();
        let reason = reason(&status, Code::ResourceExhausted);
        assert_eq!(reason, "LIMIT_EXCEEDED", "{rpc}");
        let text = "message_fields = 4064";
        assert!(status.message().contains(text), "{status}");
    }
    // The message sets its space 600,000 times. It exceeds a mebibyte.
    let spaces = [0x12, 0].repeat(600_000);
    let status = send(&server, "IndexService/CreateIndex", &spaces).await;
    let status = status.unwrap_err();
    assert_eq!(reason(&status, Code::ResourceExhausted), "LIMIT_EXCEEDED");
    let text = "index_request_bytes = 1048576";
    assert!(status.message().contains(text), "{status}");
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn stock_limits_let_an_answer_through_that_a_stock_client_takes() {
    let server = TestServer::start(|_| ()).await;
    server.create_line("line").await;
    let mut points = server.points();
    points.insert(insert("line", &[0.5; 3])).await.unwrap();
    let query = |count| v1::QueryRequest {
        index_name: "line".into(),
        states: Some(column(&vec![0.5; count])),
        radius_form: Some(v1::query_request::RadiusForm::Radius(1.0)),
        ..Default::default()
    };
    // Three neighbours of 16 bytes and a count: 80,000 states are answered in 3.9 MB, 90,000 would take 4.4 MB.
    let answer = points.query(query(80_000)).await.unwrap().into_inner();
    assert_eq!(answer.neighbors.unwrap().ids.len(), 240_000);
    let status = points.query(query(90_000)).await.unwrap_err();
    assert_eq!(reason(&status, Code::ResourceExhausted), "LIMIT_EXCEEDED");
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_call_that_waits_for_too_long_is_refused_and_health_and_administration_are_not() {
    // One thread, and little patience.
    let server = TestServer::start(|config| {
        config.admission.queue_target_ms = 1;
        config.admission.burst_ms = 1;
    });
    let server = server.await;
    server.create_ruler("line", 1000).await;
    let (refused, mut was_refused) = oneshot::channel();
    let heavy = async {
        while was_refused.try_recv().is_err() {
            let answer = server.points().knn(knn("line", &[0.0; 1000], 100)).await;
            if let Err(status) = answer {
                expect_overloaded(&status);
            }
        }
    };
    let light = async {
        let status = loop {
            if let Err(status) = server.points().knn(knn("line", &[0.0], 1)).await {
                break status;
            }
        };
        expect_overloaded(&status);
        let check = server.health().check(HealthCheckRequest::default()).await;
        assert_eq!(check.unwrap().into_inner().status(), ServingStatus::Serving);
        for _ in 0..20 {
            let list = v1::ListIndexesRequest::default();
            server.indices().list_indexes(list).await.unwrap();
        }
        server.create_line("other").await;
        refused.send(()).unwrap();
    };
    tokio::join!(heavy, light);
    server.stop().await.unwrap().unwrap();
}

fn expect_overloaded(status: &Status) {
    assert_eq!(reason(status, Code::ResourceExhausted), "OVERLOADED");
    let text = "admission.queue_target_ms = 1";
    assert!(status.message().contains(text), "{status}");
    let retry = status.get_details_retry_info().unwrap();
    assert!(retry.retry_delay.is_some_and(|delay| !delay.is_zero()));
}
