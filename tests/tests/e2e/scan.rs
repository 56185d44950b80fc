//! `Scan`: one pinned revision, whatever is written meanwhile; resumable by id.

use std::collections::BTreeSet;

use wayfold_index::Space;
use wayfold_proto::v1::{InsertRequest, OnConflict, RemoveRequest, ScanRequest};
use wayfold_tests::{Content, INCLUDE_ALL, Model, States, Stubs, number, row_states, server};

const ROWS: usize = 20_000;
const BATCH: usize = 1_000;

fn insert(states: &mut States, ids: std::ops::Range<u64>) -> InsertRequest {
    InsertRequest {
        index: "roadmap".into(),
        states: Some(row_states(&states.rows(ids.clone().count()), 7)),
        payloads: ids.clone().map(|id| id.to_string().into()).collect(),
        ids: ids.collect(),
        on_conflict: OnConflict::Replace.into(),
        ..Default::default()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scan_reads_one_revision_while_others_are_written() {
    let server = server!();
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("roadmap", "R3*SO3:0.15").await;
    let mut states = States::new(Space::se3(), 7);
    let mut model = Model::new(Space::se3());
    for batch in 0..ROWS / BATCH {
        let first = (batch * BATCH) as u64;
        let request = insert(&mut states, first..first + BATCH as u64);
        let response = stubs.insert(request.clone()).await;
        model.insert(&request, &response);
    }

    // Opened now, read later: it is larger than what the connection lets the server send ahead.
    let scan = ScanRequest {
        index: "roadmap".into(),
        include: Some(INCLUDE_ALL),
        ..Default::default()
    };
    let opened = stubs.clone();
    let (sender, receiver) = tokio::sync::oneshot::channel();
    let reader = tokio::spawn(async move {
        let mut parts = opened.points.clone().scan(scan).await.unwrap().into_inner();
        let mut read = vec![parts.message().await.unwrap().unwrap()];
        sender.send(number(&read[0].revision)).unwrap();
        while let Some(part) = parts.message().await.unwrap() {
            read.push(part);
        }
        read
    });
    let pinned = receiver.await.unwrap();
    let frozen = model.clone();
    assert_eq!(pinned, frozen.revision());

    // Everything is moved, and half of it removed.
    for batch in 0..ROWS / BATCH {
        let first = (batch * BATCH) as u64;
        let request = insert(&mut states, first..first + BATCH as u64);
        let response = stubs.insert(request.clone()).await;
        model.insert(&request, &response);
        let request = RemoveRequest {
            index: "roadmap".into(),
            ids: (first..first + BATCH as u64).step_by(2).collect(),
            ..Default::default()
        };
        let response = stubs.points.remove(request.clone()).await.unwrap();
        model.remove(&request, &response.into_inner());
    }
    let parts = reader.await.unwrap();
    assert!(parts.iter().all(|part| number(&part.revision) == pinned));
    let read = parts.iter().flat_map(|part| part.points.as_ref());
    let mut expected: Vec<_> = frozen.points().iter().collect();
    expected.sort_by_key(|point| point.id);
    let mut expected = expected.into_iter();
    for points in read {
        let rows = points.states.as_ref().unwrap().coordinates.chunks(7);
        for (row, id) in rows.zip(&points.ids) {
            let point = expected.next().unwrap();
            assert_eq!((point.id, point.row), (*id, row));
        }
    }
    assert_eq!(expected.next(), None);

    model.check_content(&Content::read(&stubs, "roadmap").await.unwrap());
    assert_eq!(stubs.describe("roadmap").await.point_count, ROWS as u64 / 2);
}

#[tokio::test]
async fn a_scan_goes_on_after_an_id() {
    let server = server!();
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("roadmap", "R3*SO3:0.15").await;
    let scan = |after_id| ScanRequest {
        index: "roadmap".into(),
        include: Some(INCLUDE_ALL),
        after_id,
        ..Default::default()
    };
    let (empty, total) = Content::scan(stubs.points.clone(), scan(None))
        .await
        .unwrap();
    assert_eq!((empty.points.len(), total), (0, 0));

    let mut states = States::new(Space::se3(), 8);
    stubs.insert(insert(&mut states, 0..100)).await;
    let last = (1 << 63) - 1;
    stubs.insert(insert(&mut states, last..last + 1)).await;
    for (after, first, count) in [(0, 1, 100), (41, 42, 59), (99, last, 1), (98, 99, 2)] {
        let read = Content::scan(stubs.points.clone(), scan(Some(after))).await;
        let ids: BTreeSet<u64> = read.unwrap().0.points.into_keys().collect();
        assert_eq!((ids.first(), ids.len()), (Some(&first), count));
    }
    let (none, total) = Content::scan(stubs.points.clone(), scan(Some(last)))
        .await
        .unwrap();
    assert_eq!((none.points.len(), total), (0, 101));
}
