//! The health service follows the life of the server.

use crate::harness::TestServer;
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
