//! Every call against every kind of credential. A call without a row fails the test.

mod certificates;
mod streams;

use std::{fs, path::Path};

use futures_util::stream;
use prost::Message;
use prost_types::FileDescriptorSet;
use sha2::{Digest, Sha256};
use tonic::{
    Code, Request, Status, Streaming, client::Grpc, codegen::http::uri::PathAndQuery,
    transport::Channel,
};
use tonic_types::StatusExt;
use wayfold_proto::v1;
use wayfold_server::identity::Role;

use crate::{
    harness::{TestServer, creation, insert, reason},
    raw::Raw,
};

/// The identities by name, which is that of their token and their certificate too: the name says the role, and what is
/// special.
const IDENTITIES: [(&str, Role, &str); 6] = [
    ("reader", Role::Read, "*"),
    ("writer", Role::Write, "arm*"),
    ("admin", Role::Admin, "a*m"),
    ("admin of the leg", Role::Admin, "leg"),
    ("expired", Role::Admin, "*"),
    ("revoked", Role::Admin, "*"),
];

/// The line of an identity's token.
fn token_line(name: &str) -> String {
    let digest = Sha256::digest(name);
    let digest: String = digest.iter().map(|byte| format!("{byte:02x}")).collect();
    format!("token_sha256 = \"{digest}\"")
}

/// Writes the identities but one, with the line of the credential of each.
fn write_identities(file: &Path, but: &str, credential_line: impl Fn(&str) -> String) {
    let mut text = String::new();
    for (name, role, pattern) in IDENTITIES.into_iter().filter(|(name, ..)| *name != but) {
        text += &format!(
            "[[identity]]\nname = \"{name}\"\nrole = \"{role}\"\nindexes = [\"{pattern}\"]\n{}\n",
            credential_line(name)
        );
        if name == "expired" {
            text += "expires = \"2001-01-01T00:00:00Z\"\n";
        }
    }
    // A file that is renamed is never read in part.
    let whole = file.with_extension("new");
    fs::write(&whole, text).unwrap();
    fs::rename(whole, file).unwrap();
}

async fn start(file: &Path) -> TestServer {
    write_identities(file, "", token_line);
    let file = file.to_str().unwrap().to_owned();
    TestServer::start(|config| config.access.identities = file).await
}

/// The role that a call needs, whether the index counts, and a request for the index `arm`.
fn row(method: &str) -> (Role, bool, Vec<u8>) {
    let index_name = || "arm".to_owned();
    macro_rules! of {
        ($request:ident, $role:ident) => {
            (
                Role::$role,
                true,
                v1::$request {
                    index_name: index_name(),
                    ..Default::default()
                }
                .encode_to_vec(),
            )
        };
    }
    match method {
        "IndexService/GetServer" | "IndexService/ListIndexes" => (Role::Read, false, Vec::new()),
        "IndexService/CreateIndex" => {
            let request = v1::CreateIndexRequest {
                name: index_name(),
                ..Default::default()
            };
            (Role::Admin, true, request.encode_to_vec())
        }
        "IndexService/RestoreIndex" => {
            let request = v1::RestoreIndexRequest {
                name: index_name(),
                ..Default::default()
            };
            (Role::Admin, true, request.encode_to_vec())
        }
        "IndexService/GetIndex" => {
            let index_name = index_name();
            let request = v1::GetIndexRequest { index_name };
            (Role::Read, true, request.encode_to_vec())
        }
        "IndexService/DeleteIndex" => of!(DeleteIndexRequest, Admin),
        "IndexService/SnapshotIndex" => of!(SnapshotIndexRequest, Read),
        "IndexService/VerifyIndex" => of!(VerifyIndexRequest, Read),
        "PointService/Insert" => of!(InsertRequest, Write),
        "PointService/Update" => of!(UpdateRequest, Write),
        "PointService/Remove" => of!(RemoveRequest, Write),
        "PointService/OpenSession" => of!(OpenSessionRequest, Write),
        "PointService/Write" => of!(WriteRequest, Write),
        "PointService/Get" => of!(GetRequest, Read),
        "PointService/Knn" => of!(KnnRequest, Read),
        "PointService/Query" => of!(QueryRequest, Read),
        "PointService/Scan" => of!(ScanRequest, Read),
        "PointService/Watch" => of!(WatchRequest, Read),
        "PointService/StreamKnn" => {
            let knn = v1::KnnRequest {
                index_name: index_name(),
                ..Default::default()
            };
            let request = v1::StreamKnnRequest { knn: Some(knn) };
            (Role::Read, true, request.encode_to_vec())
        }
        other => panic!("{other} has no row: which role does it need?"),
    }
}

/// The calls of the contract.
fn methods() -> Vec<String> {
    let files = FileDescriptorSet::decode(v1::FILE_DESCRIPTOR_SET).unwrap();
    let ours = files
        .file
        .iter()
        .filter(|file| file.package() == "wayfold.v1");
    let services = ours.flat_map(|file| &file.service);
    let methods = services.flat_map(|service| {
        let name = |method: &prost_types::MethodDescriptorProto| {
            format!("{}/{}", service.name(), method.name())
        };
        service.method.iter().map(name).collect::<Vec<_>>()
    });
    methods.collect()
}

/// Calls with a token, and returns the first answer or the refusal.
async fn call(channel: &Channel, method: &str, authorization: Option<&str>) -> Result<(), Status> {
    let mut grpc = Grpc::new(channel.clone());
    grpc.ready().await.unwrap();
    let mut request = Request::new(stream::iter([row(method).2]));
    if let Some(value) = authorization {
        let metadata = request.metadata_mut();
        metadata.insert("authorization", value.parse().unwrap());
    }
    let path: PathAndQuery = format!("/wayfold.v1.{method}").parse().unwrap();
    let mut answers = grpc.streaming(request, path, Raw).await?.into_inner();
    let Some(answer) = answers.message().await? else {
        return Ok(());
    };
    if method != "PointService/StreamKnn" {
        return Ok(());
    }
    match v1::StreamKnnResponse::decode(&*answer).unwrap().result {
        Some(v1::stream_knn_response::Result::Error(status)) => Err(Status::with_details(
            Code::from_i32(status.code),
            status.message.clone(),
            status.encode_to_vec().into(),
        )),
        _ => Ok(()),
    }
}

fn bearer(token: &str) -> String {
    format!("Bearer {token}")
}

/// A call without rights, by the kind of its credential: its channel, its authorization and the reason of its refusal.
type StrangeCaller<'a> = (&'a Channel, Option<String>, &'a str);

/// Asserts for every call that it refuses the strangers, and that the identities whose channel and authorization `shown`
/// tells have their rights and no others.
async fn assert_rights<'a>(
    strangers: &[StrangeCaller<'_>],
    shown: impl Fn(&str) -> (&'a Channel, Option<String>),
) {
    let methods = methods();
    assert_eq!(methods.len(), 19);
    for method in methods {
        let (role, has_index, _) = row(&method);
        for (channel, value, expected) in strangers {
            let status = call(channel, &method, value.as_deref()).await.unwrap_err();
            let found = reason(&status, Code::Unauthenticated);
            assert_eq!(found, *expected, "{method} {value:?}");
        }
        for (name, own, pattern) in &IDENTITIES[..4] {
            let (channel, value) = shown(name);
            let answer = call(channel, &method, value.as_deref()).await;
            let expected = match () {
                () if *own < role => Some("ROLE_TOO_LOW"),
                () if has_index && *pattern == "leg" => Some("INDEX_NOT_ALLOWED"),
                () => None,
            };
            match (answer, expected) {
                (Err(status), Some(expected)) => {
                    let found = reason(&status, Code::PermissionDenied);
                    assert_eq!(found, expected, "{method} {name}");
                    let info = status.get_details_error_info().unwrap();
                    assert_eq!(info.metadata["identity"], *name);
                }
                (Err(status), None) => {
                    let denied = [Code::PermissionDenied, Code::Unauthenticated];
                    assert!(
                        !denied.contains(&status.code()),
                        "{method} {name} {status:?}"
                    );
                }
                (Ok(()), None) => {}
                (Ok(()), Some(expected)) => panic!("{method} {name}: not {expected}"),
            }
        }
    }
}

#[tokio::test]
async fn every_call_refuses_every_wrong_token() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("identities.toml");
    let server = start(&file).await;
    let channel = &server.channel;
    call(channel, "PointService/Knn", Some(&bearer("revoked")))
        .await
        .unwrap_err();
    write_identities(&file, "revoked", token_line);
    // The server looks at the file once a second.
    while let Err(status) = call(channel, "PointService/Knn", Some(&bearer("revoked"))).await
        && status.code() != Code::Unauthenticated
    {}
    let strangers = [
        (None, "NO_CREDENTIAL"),
        (Some("Basic YWRtaW46".to_owned()), "NO_CREDENTIAL"),
        (Some("Bearer".to_owned()), "NO_CREDENTIAL"),
        (Some(bearer("")), "WRONG_CREDENTIAL"),
        (Some(bearer("adminx")), "WRONG_CREDENTIAL"),
        (Some(bearer("expired")), "IDENTITY_EXPIRED"),
        (Some(bearer("revoked")), "WRONG_CREDENTIAL"),
    ];
    let strangers = strangers.map(|(value, expected)| (channel, value, expected));
    assert_rights(&strangers, |name| (channel, Some(bearer(name)))).await;
    server.stop().await.unwrap().unwrap();
}

fn with_token<Q>(token: &str, message: Q) -> Request<Q> {
    let mut request = Request::new(message);
    let value = bearer(token).parse().unwrap();
    request.metadata_mut().insert("authorization", value);
    request
}

/// A planner that may not create indices opens one that exists by the same call.
#[tokio::test]
async fn whoever_may_read_an_index_finds_it_by_creating_it() {
    let directory = tempfile::tempdir().unwrap();
    let server = start(&directory.path().join("identities.toml")).await;
    let create = async |token: &str, name: &str, space: &str| {
        let request = with_token(token, creation(name, space));
        server.indices().create_index(request).await
    };
    let created = create("admin", "arm", "R1").await.unwrap().into_inner();
    assert!(created.created);
    for token in ["reader", "writer"] {
        let found = create(token, "arm", "R1").await.unwrap().into_inner();
        assert_eq!((found.created, found.index), (false, created.index.clone()));
        let other = create(token, "arm", "R2").await.unwrap_err();
        assert_eq!(reason(&other, Code::AlreadyExists), "INDEX_EXISTS");
        let missing = create(token, "arm-2", "R1").await.unwrap_err();
        assert_eq!(reason(&missing, Code::PermissionDenied), "ROLE_TOO_LOW");
    }
    let unseen = create("admin of the leg", "arm", "R1").await.unwrap_err();
    assert_eq!(reason(&unseen, Code::PermissionDenied), "INDEX_NOT_ALLOWED");
    server.stop().await.unwrap().unwrap();
}

/// The refusal that ends a stream before its last message.
async fn refusal_of<M>(mut stream: Streaming<M>) -> Status {
    loop {
        match stream.message().await {
            Ok(message) => assert!(message.is_some(), "the stream came to its end"),
            Err(status) => break status,
        }
    }
}

#[tokio::test]
async fn lists_show_what_the_identity_may_see_and_streams_end_with_its_rights() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("identities.toml");
    let server = start(&file).await;
    for (token, name) in [("admin", "arm"), ("admin of the leg", "leg")] {
        let request = with_token(token, creation(name, "R1"));
        server.indices().create_index(request).await.unwrap();
    }
    for (token, expected) in [
        ("reader", vec!["arm", "leg"]),
        ("writer", vec!["arm"]),
        ("admin of the leg", vec!["leg"]),
    ] {
        let mut names = Vec::new();
        let mut page_token = String::new();
        loop {
            let request = v1::ListIndexesRequest {
                page_size: 1,
                page_token,
            };
            let request = with_token(token, request);
            let page = server.indices().list_indexes(request).await.unwrap();
            let page = page.into_inner();
            // The token of the next page has a name: an empty page would tell one that the identity may not see.
            assert_eq!(page.indexes.len(), 1, "{token}");
            names.extend(page.indexes.into_iter().map(|index| index.name));
            page_token = page.next_page_token;
            if page_token.is_empty() {
                break;
            }
        }
        assert_eq!(names, expected, "{token}");
    }

    let index_name = || "arm".to_owned();
    // More than the buffers between the server and a client hold.
    for _ in 0..6 {
        let request = with_token("admin", insert("arm", &[0.0; 50_000]));
        server.points().insert(request).await.unwrap();
    }
    let watch = v1::WatchRequest {
        index_name: index_name(),
        ..Default::default()
    };
    let watch = server.points().watch(with_token("reader", watch)).await;
    let mut watch = watch.unwrap().into_inner();
    watch.message().await.unwrap().unwrap();
    let scan = v1::ScanRequest {
        index_name: index_name(),
        page_size: 64,
        ..Default::default()
    };
    let scan = server.points().scan(with_token("reader", scan)).await;
    let mut scan = scan.unwrap().into_inner();
    scan.message().await.unwrap().unwrap();
    let snapshot = v1::SnapshotIndexRequest {
        index_name: index_name(),
        ..Default::default()
    };
    let snapshot = with_token("reader", snapshot);
    let snapshot = server.indices().snapshot_index(snapshot).await;
    let mut snapshot = snapshot.unwrap().into_inner();
    snapshot.message().await.unwrap().unwrap();
    write_identities(&file, "reader", token_line);
    let looked = || async {
        let request = with_token("reader", v1::GetServerRequest {});
        server.indices().get_server(request).await
    };
    while looked().await.is_ok() {}
    let watched = watch.message().await.unwrap_err();
    let (scanned, copied) = (refusal_of(scan).await, refusal_of(snapshot).await);
    for status in [watched, scanned, copied] {
        assert_eq!(reason(&status, Code::Unauthenticated), "IDENTITY_REVOKED");
    }
    server.stop().await.unwrap().unwrap();
}

/// Members trust each other: a client that could ask for a copy would need no rights.
#[tokio::test]
async fn clients_cannot_make_the_calls_of_members() {
    let server = TestServer::start(|_| ()).await;
    for rpc in ["Copy", "Stored"] {
        let mut client = Grpc::new(server.channel.clone());
        client.ready().await.unwrap();
        let path = format!("/wayfold.member.v1.MemberService/{rpc}");
        let path: PathAndQuery = path.parse().unwrap();
        let refused = client.unary(Request::new(Vec::new()), path, Raw).await;
        assert_eq!(refused.unwrap_err().code(), Code::Unimplemented);
    }
}
