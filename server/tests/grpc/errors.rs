//! A failed call carries its code and `google.rpc` details that a program can read.

use crate::harness::{TestServer, insert, knn, reason, uid_of};
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
async fn missing_and_conflicting_things_are_named() {
    let server = TestServer::start(|_| ()).await;
    let status = server.points().knn(knn("none", &[0.0], 1)).await;
    let status = status.unwrap_err();
    assert_eq!(reason(&status, Code::NotFound), "INDEX_NOT_FOUND");
    let resource = status.get_details_resource_info().unwrap();
    assert_eq!(resource.resource_name, "none");

    server.create_ruler("line", 3).await;
    let request = v1::GetRequest {
        index_name: "line".into(),
        ids: vec![1, 7, 2, 9],
        ..Default::default()
    };
    let status = server.points().get(request).await.unwrap_err();
    assert_eq!(reason(&status, Code::NotFound), "POINTS_NOT_FOUND");
    let metadata = status.get_details_error_info().unwrap().metadata;
    assert_eq!((&*metadata["index"], &*metadata["ids"]), ("line", "7,9"));

    let mut request = insert("line", &[0.5]);
    request.ids = vec![2];
    let status = server.points().insert(request).await.unwrap_err();
    assert_eq!(reason(&status, Code::AlreadyExists), "POINTS_EXIST");
    let metadata = status.get_details_error_info().unwrap().metadata;
    assert_eq!(metadata["ids"], "2");

    let request = v1::CreateIndexRequest {
        name: "line".into(),
        space_form: Some(v1::create_index_request::SpaceForm::SpaceText("SO3".into())),
        ..Default::default()
    };
    let status = server.indices().create_index(request).await.unwrap_err();
    assert_eq!(reason(&status, Code::AlreadyExists), "INDEX_EXISTS");
    let resource = status.get_details_resource_info().unwrap();
    assert_eq!(resource.resource_name, "line");
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_precondition_that_fails_is_named() {
    let server = TestServer::start(|_| ()).await;
    let index = server.create_line("line").await;
    let mut request = insert("line", &[0.0]);
    request.uid = format!("not-{}", uid_of(&index));
    let status = server.points().insert(request).await.unwrap_err();
    assert_eq!(reason(&status, Code::FailedPrecondition), "UID_MISMATCH");
    let failure = status.get_details_precondition_failure().unwrap();
    assert_eq!(failure.violations[0].r#type, "UID_MISMATCH");
    assert_eq!(failure.violations[0].subject, "line");
    let metadata = status.get_details_error_info().unwrap().metadata;
    assert_eq!(metadata["found"], uid_of(&index));
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_limit_is_named_with_its_value() {
    let server = TestServer::start(|config| config.limits.max_k = 5).await;
    server.create_line("line").await;
    let status = server.points().knn(knn("line", &[0.0], 6)).await;
    let status = status.unwrap_err();
    assert_eq!(reason(&status, Code::ResourceExhausted), "LIMIT_EXCEEDED");
    let quota = status.get_details_quota_failure().unwrap();
    assert_eq!(quota.violations[0].quota_value, 5);
    let metadata = status.get_details_error_info().unwrap().metadata;
    assert_eq!((&*metadata["value"], &*metadata["requested"]), ("5", "6"));
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
