//! Snapshots, restores and verifications over the network. A stream that is not read blocks no other call, and each
//! refusal gives its reason.

use futures_util::stream;
use tonic::{Code, Status};
use tonic_types::StatusExt;
use wayfold_proto::{
    snapshot::{Content, Reader},
    v1::{self, verify_index_response::Result as Answer},
};

use crate::harness::{TestServer, insert, reason, uid_of};

fn snapshot_of(name: &str) -> v1::SnapshotIndexRequest {
    v1::SnapshotIndexRequest {
        index: name.into(),
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

#[tokio::test]
async fn a_snapshot_that_is_not_read_holds_up_nobody_and_stays_what_it_is() {
    let server = TestServer::start(|_| ()).await;
    server.create_ruler("line", 200_000).await;
    let answer = server.indices().snapshot_index(snapshot_of("line")).await;
    let mut answers = answer.unwrap().into_inner();
    let first = answers.message().await.unwrap().unwrap().part.unwrap();
    let mut reader = Reader::new();
    let Content::Header(header) = reader.read(&first).unwrap() else {
        panic!("no header");
    };

    // More than the connection holds is still to come, and others read and write.
    let mut points = server.points();
    for round in 0..20 {
        let request = v1::RemoveRequest {
            index: "line".into(),
            ids: (0..10_000).map(|id| round * 10_000 + id).collect(),
            ..Default::default()
        };
        points.remove(request).await.unwrap();
    }
    points.insert(insert("line", &[0.5])).await.unwrap();
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
async fn a_restore_that_is_refused_says_why() {
    let server = TestServer::start(|config| {
        config.limits.indexes = 2;
        config.grpc.max_message_bytes = 1_000_000;
    })
    .await;
    server.create_ruler("line", 30_000).await;
    let good = parts(&server, "line").await;
    let index = restore(&server, "copy", &good).await.unwrap();
    assert_eq!((index.name.as_str(), index.point_count), ("copy", 30_000));

    let taken = restore(&server, "copy", &good).await.unwrap_err();
    assert_eq!(reason(&taken, Code::AlreadyExists), "INDEX_EXISTS");
    assert!(taken.get_details_resource_info().is_some());
    let full = restore(&server, "third", &good).await.unwrap_err();
    assert_eq!(reason(&full, Code::ResourceExhausted), "LIMIT_EXCEEDED");
    let request = v1::DeleteIndexRequest {
        index: "copy".into(),
        uid: uid_of(&index),
    };
    server.indices().delete_index(request).await.unwrap();

    let cut = restore(&server, "copy", &good[..2]).await.unwrap_err();
    assert_eq!(reason(&cut, Code::InvalidArgument), "SNAPSHOT_CUT_SHORT");
    let fields = cut.get_details_bad_request().unwrap().field_violations;
    assert_eq!(fields[0].field, "part");
    let mut damaged = good.clone();
    let mut content = damaged[1].content.to_vec();
    content[9_999] ^= 1;
    damaged[1].content = content.into();
    let damaged = restore(&server, "copy", &damaged).await.unwrap_err();
    assert_eq!(reason(&damaged, Code::InvalidArgument), "SNAPSHOT_DAMAGED");
    assert!(damaged.message().contains("part 2"), "{damaged}");
    let mut large = good.clone();
    large[1].content = vec![0; 1_200_000].into();
    let large = restore(&server, "copy", &large).await.unwrap_err();
    assert_eq!(reason(&large, Code::ResourceExhausted), "LIMIT_EXCEEDED");
    assert!(
        large.message().contains("grpc.max_message_bytes"),
        "{large}"
    );
    assert!(large.message().ends_with("raise the limit"), "{large}");
    let none = restore(&server, "copy", &[]).await.unwrap_err();
    assert_eq!(reason(&none, Code::InvalidArgument), "SNAPSHOT_CUT_SHORT");
    restore(&server, "copy", &good).await.unwrap();
    server.stop().await.unwrap().unwrap();
}

#[tokio::test]
async fn a_verification_ends_with_its_report_or_at_its_deadline() {
    let server = TestServer::start(|_| ()).await;
    server.create_ruler("line", 50_000).await;
    let request = v1::VerifyIndexRequest {
        index: "line".into(),
        query_count: Some(20),
        ..Default::default()
    };
    let answer = server.indices().verify_index(request.clone()).await;
    let mut answers = answer.unwrap().into_inner();
    let mut last = None;
    while let Some(answer) = answers.message().await.unwrap() {
        assert!(!matches!(last, Some(Answer::Report(_))));
        last = answer.result;
    }
    let Some(Answer::Report(report)) = last else {
        panic!("no report but {last:?}");
    };
    assert_eq!(
        (report.disagreement_count, report.stored_point_count),
        (0, 50_000)
    );

    let mut late = tonic::Request::new(v1::VerifyIndexRequest {
        query_count: Some(1000),
        k: Some(100),
        ..request
    });
    late.set_timeout(std::time::Duration::from_millis(20));
    let ended = async {
        let mut answers = server.indices().verify_index(late).await?.into_inner();
        while answers.message().await?.is_some() {}
        Ok::<_, Status>(())
    };
    let status = ended.await.unwrap_err();
    // The client keeps the deadline too, and may be the first.
    assert!(
        matches!(status.code(), Code::DeadlineExceeded | Code::Cancelled),
        "{status}"
    );
    server.stop().await.unwrap().unwrap();
}
