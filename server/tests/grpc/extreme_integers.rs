//! Every method of both services answers or refuses each extreme integer with a status of its own.

use std::time::Duration;

use futures_util::stream;
use prost::Message;
use prost_reflect::{DynamicMessage, MethodDescriptor, ReflectMessage};
use tonic::{Code, Request, Status, client::Grpc, transport::Channel};
use wayfold_proto::v1;

use crate::{
    extremes::{pool, requests, variants},
    harness::{TestServer, insert, uid_of},
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
