//! The health service follows the life of the server.

use std::time::Duration;

use crate::{
    bare::{Connection, status},
    harness::TestServer,
};
use bytes::{BufMut, BytesMut};
use tokio::time::timeout;
use tonic::Code;
use tonic_health::pb::{HealthCheckRequest, health_check_response::ServingStatus};

fn of(service: &str) -> HealthCheckRequest {
    HealthCheckRequest {
        service: service.into(),
    }
}

#[tokio::test]
async fn every_service_is_serving_while_the_server_runs() {
    let server = TestServer::start(|_| ()).await;
    for service in ["", "wayfold.v1.IndexService", "wayfold.v1.PointService"] {
        let report = server.health().check(of(service)).await.unwrap();
        let status = report.into_inner().status();
        assert_eq!(status, ServingStatus::Serving, "{service}");
    }
    let unknown = server.health().check(of("wayfold.v1.Other")).await;
    assert_eq!(unknown.unwrap_err().code(), Code::NotFound);
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn watchers_learn_that_the_server_stops_and_do_not_delay_it() {
    let server = TestServer::start(|_| ()).await;
    let mut watches = Vec::new();
    for service in ["", "wayfold.v1.IndexService", "wayfold.v1.PointService"] {
        let mut reports = server
            .health()
            .watch(of(service))
            .await
            .unwrap()
            .into_inner();
        let first = reports.message().await.unwrap().unwrap();
        assert_eq!(first.status(), ServingStatus::Serving);
        watches.push(reports);
    }
    let ended = server.stop();
    for mut reports in watches {
        let last = reports.message().await.unwrap().unwrap();
        assert_eq!(last.status(), ServingStatus::NotServing);
        assert!(reports.message().await.unwrap().is_none());
    }
    ended.await.unwrap().unwrap();
}

/// Watches last for as long as their clients like, and no budget counts them.
#[tokio::test]
async fn a_connection_has_few_watches_of_health_and_can_still_ask() {
    let server = TestServer::start(|_| ()).await;
    let mut health = server.health();
    let mut watches = Vec::new();
    for _ in 0..8 {
        let mut reports = health.watch(of("")).await.unwrap().into_inner();
        reports.message().await.unwrap().unwrap();
        watches.push(reports);
    }
    let refused = health.watch(of("")).await.unwrap_err();
    assert_eq!(refused.code(), Code::ResourceExhausted);
    health.check(of("")).await.unwrap();
    drop(watches);
    server.stop().await.unwrap().unwrap();
}

/// These methods serve strangers, and their requests are not counted.
#[tokio::test]
async fn a_large_request_for_health_or_reflection_ends_at_its_header() {
    let server = TestServer::start(|_| ()).await;
    let mut connection = Connection::open(server.address).await;
    // tonic's reflection ends its stream at a request that it cannot read, and names no error.
    for (method, code) in [
        ("grpc.health.v1.Health/Check", Code::OutOfRange),
        ("grpc.health.v1.Health/Watch", Code::OutOfRange),
        (
            "grpc.reflection.v1.ServerReflection/ServerReflectionInfo",
            Code::Ok,
        ),
        (
            "grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo",
            Code::Ok,
        ),
    ] {
        let request = connection.request_of(method);
        let (answer, mut body) = connection.begin(request).await.unwrap();
        let mut header = BytesMut::new();
        header.put_u8(0);
        header.put_u32(1024 * 1024);
        body.send_data(header.freeze(), false).unwrap();
        let ended = timeout(Duration::from_secs(10), status(answer)).await;
        let ended = ended.expect(method).unwrap();
        assert_eq!(ended.code(), code, "{method} {ended}");
    }
    server.stop().await.unwrap().unwrap();
}
