//! Tags, `since_revision` and compare-and-set, over the wire.

use std::collections::BTreeSet;

use tonic::Code;
use wayfold_index::Space;
use wayfold_proto::v1::{
    Filter, GetRequest, InsertRequest, KnnRequest, QueryRequest, ScanRequest, UpdateRequest,
    knn_request::Count, query_request::Reach,
};
use wayfold_tests::{
    Content, INCLUDE_ALL, Refusal, States, Stubs, number, revision, row_states, server,
};

const ROWS: u64 = 600;

#[tokio::test]
async fn reads_see_the_tags_that_updates_set() {
    let server = server!();
    let mut stubs = Stubs::connect(server.uri()).await;
    let created = stubs.create("roadmap", "R3*SO3:0.15").await;
    let uid = created.revision.unwrap().uid;
    let mut states = States::new(Space::se3(), 5);
    for batch in 0..3 {
        let first = batch * ROWS / 3;
        let request = InsertRequest {
            index: "roadmap".into(),
            states: Some(row_states(&states.rows(ROWS as usize / 3), 7)),
            ids: (first..first + ROWS / 3).collect(),
            ..Default::default()
        };
        stubs.insert(request).await;
    }
    // A component in the low byte; the bit above it says pending, and stays when the component changes.
    let pending = UpdateRequest {
        index: "roadmap".into(),
        ids: (0..ROWS).filter(|id| id % 5 == 0).collect(),
        tags: vec![0x100],
        ..Default::default()
    };
    stubs.points.update(pending).await.unwrap();
    let components = UpdateRequest {
        index: "roadmap".into(),
        ids: (0..ROWS).collect(),
        tags: (0..ROWS).map(|id| id % 3).collect(),
        tag_mask: Some(0xff),
        ..Default::default()
    };
    let updated = stubs.points.update(components.clone()).await.unwrap();
    let updated = updated.into_inner();
    // Component 0 was there already.
    assert_eq!((updated.updated_count, updated.unchanged_count), (400, 200));
    let again = stubs.points.update(components).await.unwrap().into_inner();
    assert_eq!((again.updated_count, again.revision), (0, updated.revision));

    let expected = |mask: u64, value: u64, since: u64| -> BTreeSet<u64> {
        (0..ROWS)
            .filter(|id| {
                let tag = (id % 3) | if id % 5 == 0 { 0x100 } else { 0 };
                tag & mask == value && id / (ROWS / 3) + 1 > since
            })
            .collect()
    };
    for (tag_mask, tag_value, since_revision) in [
        (0xff, 0, 0),
        (0xff, 2, 0),
        (0x100, 0x100, 0),
        (0x1ff, 0x101, 0),
        (0x100, 0, 2),
        (0, 0, 1),
        (0xff, 7, 0),
    ] {
        let expected = expected(tag_mask, tag_value, since_revision);
        let filter = Some(Filter {
            tag_mask,
            tag_value,
            since_revision: revision(&uid, since_revision),
        });
        let query = QueryRequest {
            index: "roadmap".into(),
            states: Some(row_states(&states.row(), 7)),
            reach: Some(Reach::Radius(f64::INFINITY)),
            filter: filter.clone(),
            include: Some(INCLUDE_ALL),
            ..Default::default()
        };
        let all = stubs
            .points
            .query(query.clone())
            .await
            .unwrap()
            .into_inner();
        let all = all.neighbors.unwrap();
        assert_eq!(BTreeSet::from_iter(all.ids.iter().copied()), expected);
        assert!(all.tags.iter().all(|tag| tag & tag_mask == tag_value));
        assert!(all.revisions.iter().all(|r| *r > since_revision));
        assert_eq!(all.payloads.len(), all.ids.len());
        assert_eq!(all.states.unwrap_or_default().rows as usize, all.ids.len());

        let knn = KnnRequest {
            index: "roadmap".into(),
            states: query.states,
            count: Some(Count::K(10)),
            filter: filter.clone(),
            ..Default::default()
        };
        let nearest = stubs.points.knn(knn).await.unwrap().into_inner();
        let nearest = nearest.neighbors.unwrap();
        assert_eq!(nearest.ids[..], all.ids[..expected.len().min(10)]);

        let scan = ScanRequest {
            index: "roadmap".into(),
            filter,
            include: Some(INCLUDE_ALL),
            ..Default::default()
        };
        let (scanned, total) = Content::scan(stubs.points.clone(), scan).await.unwrap();
        assert_eq!(
            scanned.points.into_keys().collect::<BTreeSet<_>>(),
            expected
        );
        assert_eq!(total, ROWS);
    }
}

#[tokio::test]
async fn of_two_that_compare_and_set_one_wins() {
    let server = server!();
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("roadmap", "R2").await;
    let request = InsertRequest {
        index: "roadmap".into(),
        states: Some(row_states(&[0.0, 0.0, 1.0, 1.0], 2)),
        ids: vec![1, 2],
        payloads: vec!["a".into(), "b".into()],
        ..Default::default()
    };
    let read = stubs.insert(request).await.revision;
    let set = |ids: &[u64], tag: u64| UpdateRequest {
        index: "roadmap".into(),
        ids: ids.to_vec(),
        tags: vec![tag],
        if_revision: read.clone(),
        ..Default::default()
    };
    stubs.points.update(set(&[1], 5)).await.unwrap();
    let before = Content::read(&stubs, "roadmap").await.unwrap();
    let status = stubs.points.update(set(&[1, 2], 6)).await.unwrap_err();
    let refusal = Refusal::of(&status);
    assert_eq!(refusal.code, Code::FailedPrecondition, "{refusal:?}");
    let violations = &refusal.details.precondition_failure().unwrap().violations;
    assert!(format!("{violations:?}").contains('1'), "{violations:?}");
    assert_eq!(before, Content::read(&stubs, "roadmap").await.unwrap());
    // The other point is as it was read.
    stubs.points.update(set(&[2], 6)).await.unwrap();

    let get = GetRequest {
        index: "roadmap".into(),
        ids: vec![2, 1],
        include: Some(INCLUDE_ALL),
        ..Default::default()
    };
    let points = stubs.points.get(get).await.unwrap().into_inner();
    let points = points.points.unwrap();
    assert_eq!(points.ids, [2, 1]);
    assert_eq!(points.tags, [6, 5]);
    assert_eq!(points.payloads, ["b", "a"]);
    // A tag is not a state: the revision that stored it stays.
    let read = number(&read);
    assert_eq!(points.revisions, [read, read]);
}
