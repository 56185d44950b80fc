//! A failed call carries its code and `google.rpc` details that a program can read.

use crate::harness::{TestServer, insert, reason};
use tonic::{Code, Request};
use tonic_types::StatusExt;
use wayfold_proto::v1;

#[tokio::test]
async fn a_wrong_field_is_named() {
    let server = TestServer::start(|_| ()).await;
    server.create_line("line").await;
    let request = insert("line", &[0.0, 1.0, f64::NAN]);
    let status = server.points().insert(request).await.unwrap_err();
    assert_eq!(reason(&status, Code::InvalidArgument), "NAN");
    let fields = status.get_details_bad_request().unwrap().field_violations;
    let named: Vec<&str> = fields.iter().map(|field| &*field.field).collect();
    assert_eq!(named, ["states[2].coords[0]"]);
    assert_eq!(fields[0].reason, "NAN");
    assert!(status.message().contains("states[2].coords[0]"), "{status}");
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_call_that_this_server_does_not_know_is_unimplemented() {
    let server = TestServer::start(|_| ()).await;
    let mut client = tonic::client::Grpc::new(server.channel.clone());
    for path in [
        "/wayfold.v1.PointService/Guess",
        "/wayfold.v1.NoService/Knn",
    ] {
        client.ready().await.unwrap();
        let path = http::uri::PathAndQuery::from_static(path);
        let codec = tonic_prost::ProstCodec::<v1::KnnRequest, v1::KnnResponse>::default();
        let request = Request::new(v1::KnnRequest::default());
        let status = client.unary(request, path, codec).await.unwrap_err();
        assert_eq!(status.code(), Code::Unimplemented);
    }
    server.stop().await.unwrap().unwrap();
}
