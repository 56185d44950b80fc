//! Every method of both services answers or refuses each extreme integer with a status of its own, and none that waits spins.

use std::time::Duration;

use bytes::{BufMut, Bytes, BytesMut};
use futures_util::stream;
use prost::Message;
use prost_reflect::{DynamicMessage, MethodDescriptor, ReflectMessage};
use tonic::{Code, Request, Status, client::Grpc, transport::Channel};
use wayfold_proto::v1;
use wayfold_server::{InProcess, config::Config};

use crate::{
    extremes::{pool, requests, variants},
    harness::{TestServer, insert, uid_of},
    quiet::{quietly, two_points},
    raw::Raw,
};

/// The timeout of a call, which ends a wait for a revision that does not exist.
const TIMEOUT: Duration = Duration::from_millis(20);

/// Calls a method, streaming or not, and reads all of its answers.
async fn call(
    channel: &Channel,
    method: &MethodDescriptor,
    message: &DynamicMessage,
) -> Result<usize, Status> {
    let service = method.parent_service().full_name();
    let path = format!("/{service}/{}", method.name());
    let mut request = Request::new(stream::iter([message.encode_to_vec()]));
    request.set_timeout(TIMEOUT);
    let mut client = Grpc::new(channel.clone());
    client.ready().await.unwrap();
    let answers = client
        .streaming(request, path.parse().unwrap(), Raw)
        .await?;
    let mut answers = answers.into_inner();
    let mut count = 0;
    while answers.message().await?.is_some() {
        count += 1;
    }
    Ok(count)
}

#[tokio::test]
async fn every_method_answers_or_refuses_extreme_integers() {
    let server = TestServer::start(|_| ()).await;
    let uid = uid_of(&server.create_line("arm").await);
    for coordinate in [0.0, 1.0] {
        let request = insert("arm", &[coordinate]);
        server.points().insert(request).await.unwrap();
    }
    let session = v1::OpenSessionRequest {
        index_name: "arm".into(),
        ..Default::default()
    };
    server.points().open_session(session).await.unwrap();
    let requests = requests(&uid);
    let services = pool().services().collect::<Vec<_>>();
    for method in services.iter().flat_map(|service| service.methods()) {
        let name = method.input().full_name().to_owned();
        let of_method = |request: &&DynamicMessage| request.descriptor().full_name() == name;
        let good: Vec<_> = requests.iter().filter(of_method).collect();
        assert!(!good.is_empty(), "{} is not tried", method.full_name());
        for (what, variant) in good.into_iter().flat_map(variants) {
            println!("{what}");
            let Err(status) = call(&server.channel, &method, &variant).await else {
                continue;
            };
            let is_bug = matches!(
                status.code(),
                Code::Internal | Code::Unknown | Code::DataLoss | Code::Unavailable
            );
            assert!(!is_bug, "{status:?}");
        }
    }
}

/// A call of a method of `PointService` without a connection.
fn in_process(method: &MethodDescriptor, message: &DynamicMessage) -> http::Request<Bytes> {
    let message = message.encode_to_vec();
    let mut frame = BytesMut::new();
    frame.put_u8(0);
    frame.put_u32(message.len() as u32);
    frame.put_slice(&message);
    let service = method.parent_service().full_name();
    http::Request::post(format!("/{service}/{}", method.name()))
        .header("content-type", "application/grpc")
        .header("grpc-timeout", "1H")
        .body(frame.freeze())
        .unwrap()
}

/// A waiting call ends at its deadline. The clock of the test is paused, so the deadline comes at once.
#[tokio::test(start_paused = true)]
async fn no_method_of_points_spins_on_extreme_integers() {
    let (service, uid) = two_points().await;
    let mut calls = InProcess::new(&Config::default(), service, None).unwrap();
    let requests = requests(&uid);
    let points = pool().get_service_by_name("wayfold.v1.PointService");
    for method in points.unwrap().methods() {
        let of_method = |request: &&DynamicMessage| {
            request.descriptor().full_name() == method.input().full_name()
        };
        for (what, variant) in requests.iter().filter(of_method).flat_map(variants) {
            println!("{what}");
            quietly(calls.call(in_process(&method, &variant))).await;
        }
    }
}
