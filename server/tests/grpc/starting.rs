//! A server listens before it has read its indices, and answers each caller that it is starting.
#![cfg(unix)]

use std::{fs::File, io::Write, process::Command};

use tokio::net::TcpListener;
use tonic::Code;
use tonic_health::pb::{
    HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient,
};
use wayfold_proto::v1::{
    ListIndexesRequest, index_service_client::IndexServiceClient,
    point_service_client::PointServiceClient,
};
use wayfold_server::{
    ServerError,
    config::{Config, ZenohConfig},
    log::{Durability, OpenError},
};

use crate::harness::{connect, knn, reason};

#[tokio::test]
async fn calls_are_refused_as_starting_until_the_indices_are_read() {
    // Reading this data directory blocks until a writer opens the pipe.
    let directory = tempfile::tempdir().unwrap();
    let marker = directory.path().join("wayfold-data");
    assert!(
        Command::new("mkfifo")
            .arg(&marker)
            .status()
            .unwrap()
            .success()
    );
    let mut config = Config::default();
    config.zenoh.listen = ZenohConfig::OFF.into();
    config.http.listen = wayfold_server::config::OFF.into();
    config.data.dir = directory.path().to_str().unwrap().into();
    assert_eq!(config.data.durability, Durability::Fsync);
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let run = wayfold_server::run(config, listener, std::future::pending());
    let ended = tokio::spawn(run);

    let channel = connect(address).await;
    let mut indexes = IndexServiceClient::new(channel.clone());
    let refused = indexes.list_indexes(ListIndexesRequest::default()).await;
    assert_eq!(reason(&refused.unwrap_err(), Code::Unavailable), "STARTING");
    let mut points = PointServiceClient::new(channel.clone());
    let refused = points.knn(knn("arm", &[1.0], 1)).await;
    assert_eq!(reason(&refused.unwrap_err(), Code::Unavailable), "STARTING");
    let health = HealthClient::new(channel)
        .check(HealthCheckRequest::default())
        .await;
    let status = health.unwrap().into_inner().status();
    assert_eq!(status, ServingStatus::NotServing);

    // The bytes that the pipe yields are no marker.
    let mut pipe = File::options().write(true).open(marker).unwrap();
    pipe.write_all(&[b'x'; 2000]).unwrap();
    assert!(matches!(
        ended.await.unwrap(),
        Err(ServerError::Data(OpenError::Foreign { .. }))
    ));
}
