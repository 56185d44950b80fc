//! Streams end with the rights of their caller.

use http::header;
use tonic::Code;
use wayfold_proto::v1;

use super::{bearer, start, token_line, write_identities};
use crate::{
    bare::{Connection, frame, status},
    harness::reason,
};

#[tokio::test]
async fn streams_of_requests_end_with_the_rights_of_a_caller_who_sends_none() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("identities.toml");
    let server = start(&file).await;
    let mut connection = Connection::open(server.address).await;
    let mut begin = async |rpc| {
        let request = connection.request(rpc);
        let request = request.header(header::AUTHORIZATION, bearer("admin"));
        connection.begin(request).await.unwrap()
    };
    let (streaming, _requests) = begin("PointService/StreamKnn").await;
    let (restoring, _parts) = begin("IndexService/RestoreIndex").await;
    // Those before it have begun once it is answered.
    let (described, mut request) = begin("IndexService/GetServer").await;
    let whole = frame(&v1::GetServerRequest {});
    request.send_data(whole, true).unwrap();
    assert_eq!(status(described).await.unwrap().code(), Code::Ok);
    write_identities(&file, "admin", token_line);
    for answer in [streaming, restoring] {
        let refused = status(answer).await.unwrap();
        assert_eq!(reason(&refused, Code::Unauthenticated), "IDENTITY_REVOKED");
    }
    server.stop().await.unwrap().unwrap();
}
