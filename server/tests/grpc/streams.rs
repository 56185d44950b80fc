//! Streams of scans, snapshots, restores and verifications that are unread, too large or late.

use futures_util::stream;
use tonic::{Code, Status};
use tonic_types::StatusExt;
use wayfold_proto::{
    snapshot::{Content, Reader},
    v1,
};

use crate::harness::{TestServer, insert, reason, uid_of};

fn snapshot_of(name: &str) -> v1::SnapshotIndexRequest {
    v1::SnapshotIndexRequest {
        index_name: name.into(),
        min_revision: None,
    }
}

async fn parts(server: &TestServer, name: &str) -> Vec<v1::SnapshotPart> {
    let answer = server.indices().snapshot_index(snapshot_of(name)).await;
    let mut answers = answer.unwrap().into_inner();
    let mut parts = Vec::new();
    while let Some(answer) = answers.message().await.unwrap() {
        parts.push(answer.part.unwrap());
    }
    parts
}

async fn restore(
    server: &TestServer,
    name: &str,
    parts: &[v1::SnapshotPart],
) -> Result<v1::Index, Status> {
    let messages = parts.iter().map(|part| v1::RestoreIndexRequest {
        name: name.into(),
        part: Some(part.clone()),
    });
    let messages: Vec<_> = messages.collect();
    let answer = server.indices().restore_index(stream::iter(messages)).await;
    answer.map(|answer| answer.into_inner().index.unwrap())
}

/// Replaces a ruler of 200,000 points by another.
async fn others_write(server: &TestServer) {
    let mut points = server.points();
    for round in 0..20 {
        let request = v1::RemoveRequest {
            index_name: "line".into(),
            ids: (0..10_000).map(|id| round * 10_000 + id).collect(),
            ..Default::default()
        };
        points.remove(request).await.unwrap();
    }
    points.insert(insert("line", &[0.5])).await.unwrap();
}

#[tokio::test]
async fn an_unread_scan_blocks_no_call_and_keeps_its_revision() {
    let server = TestServer::start(|_| ()).await;
    let index = server.create_ruler("line", 200_000).await;
    let scan = async || {
        let request = v1::ScanRequest {
            index_name: "line".into(),
            ..Default::default()
        };
        let answer = server.points().scan(request).await;
        answer.unwrap().into_inner()
    };
    let mut answers = scan().await;
    let mut next = answers.message().await.unwrap();
    others_write(&server).await;
    let (mut ids, mut coordinates) = (Vec::new(), Vec::new());
    while let Some(part) = next {
        let revision = part.revision.unwrap();
        assert_eq!((revision.uid, revision.number), (uid_of(&index), 4));
        assert_eq!(part.point_count, 200_000);
        let points = part.points.unwrap();
        ids.extend(points.ids);
        coordinates.extend(points.states.unwrap().coordinates);
        next = answers.message().await.unwrap();
    }
    assert!(ids.into_iter().eq(0..200_000));
    assert!(coordinates.into_iter().eq((0..200_000).map(f64::from)));
    let later = scan().await.message().await.unwrap().unwrap();
    assert_eq!((later.revision.unwrap().number, later.point_count), (25, 1));
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn an_unread_snapshot_blocks_no_call_and_keeps_its_revision() {
    let server = TestServer::start(|_| ()).await;
    server.create_ruler("line", 200_000).await;
    let answer = server.indices().snapshot_index(snapshot_of("line")).await;
    let mut answers = answer.unwrap().into_inner();
    let first = answers.message().await.unwrap().unwrap().part.unwrap();
    let mut reader = Reader::new();
    let Content::Header(header) = reader.read(&first).unwrap() else {
        panic!("no header");
    };

    // The rest of the stream exceeds the buffers of the connection.
    others_write(&server).await;
    let other = parts(&server, "line").await;
    assert_eq!(other.len(), 3);

    let mut read = 0..;
    while let Some(answer) = answers.message().await.unwrap() {
        if let Content::Points(points, _) = reader.read(&answer.part.unwrap()).unwrap() {
            for id in points.ids {
                assert_eq!(Some(id), read.next());
            }
        }
    }
    reader.finish().unwrap();
    assert_eq!((header.point_count, read.start), (200_000, 200_000));
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_refused_restore_is_a_status_with_details() {
    let server = TestServer::start(|config| config.grpc.max_message_bytes = 1_000_000).await;
    server.create_ruler("line", 30_000).await;
    let good = parts(&server, "line").await;
    let cut = restore(&server, "copy", &good[..2]).await.unwrap_err();
    assert_eq!(reason(&cut, Code::InvalidArgument), "SNAPSHOT_CUT_SHORT");
    let fields = cut.get_details_bad_request().unwrap().field_violations;
    assert_eq!(fields[0].field, "part");
    let none = restore(&server, "copy", &[]).await.unwrap_err();
    assert_eq!(reason(&none, Code::InvalidArgument), "SNAPSHOT_CUT_SHORT");

    let mut large = good.clone();
    large[1].content = vec![0; 1_200_000].into();
    let large = restore(&server, "copy", &large).await.unwrap_err();
    assert_eq!(reason(&large, Code::ResourceExhausted), "LIMIT_EXCEEDED");
    assert!(
        large.message().contains("grpc.max_message_bytes"),
        "{large}"
    );
    assert!(large.message().ends_with("raise the limit"), "{large}");

    let index = restore(&server, "copy", &good).await.unwrap();
    assert_eq!((index.name.as_str(), index.point_count), ("copy", 30_000));
    let taken = restore(&server, "copy", &good).await.unwrap_err();
    assert_eq!(reason(&taken, Code::AlreadyExists), "INDEX_EXISTS");
    assert!(taken.get_details_resource_info().is_some());
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_verification_ends_at_its_deadline() {
    let server = TestServer::start(|_| ()).await;
    server.create_ruler("line", 50_000).await;
    let mut late = tonic::Request::new(v1::VerifyIndexRequest {
        index_name: "line".into(),
        query_count: Some(1000),
        k: Some(100),
        ..Default::default()
    });
    late.set_timeout(std::time::Duration::from_millis(20));
    let ended = async {
        let mut answers = server.indices().verify_index(late).await?.into_inner();
        while answers.message().await?.is_some() {}
        Ok::<_, Status>(())
    };
    let status = ended.await.unwrap_err();
    // The client enforces the deadline too, and may end the call first.
    assert!(
        matches!(status.code(), Code::DeadlineExceeded | Code::Cancelled),
        "{status}"
    );
    server.stop().await.unwrap().unwrap();
}
