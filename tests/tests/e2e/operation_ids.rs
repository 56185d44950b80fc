//! `operation_id`: a call takes effect once, however often and from however many places it is sent.

use tokio::task::JoinSet;
use tonic::Code;
use wayfold_index::Space;
use wayfold_proto::v1::{InsertRequest, RemoveRequest, UpdateRequest};
use wayfold_tests::{
    Content, Refusal, ServerProcess, States, Stubs, k_nearest, number, revision, row_states, server,
};

const TWINS: usize = 32;

async fn index() -> (ServerProcess, Stubs, States) {
    let server = server!();
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("roadmap", "R3*SO3:0.15").await;
    (server, stubs, States::new(Space::se3(), 3))
}

fn insert(states: &mut States, rows: usize, operation_id: &str) -> InsertRequest {
    InsertRequest {
        index: "roadmap".into(),
        states: Some(row_states(&states.rows(rows), 7)),
        neighbors: Some(k_nearest(5)),
        operation_id: operation_id.into(),
        ..Default::default()
    }
}

#[tokio::test]
async fn a_retry_gets_the_original_answer() {
    let (_server, mut stubs, mut states) = index().await;
    let request = insert(&mut states, 10, "first");
    let original = stubs.insert(request.clone()).await;
    // The index has moved on; the answer has not.
    stubs.insert(insert(&mut states, 10, "second")).await;
    let before = Content::read(&stubs, "roadmap").await.unwrap();
    assert_eq!(stubs.insert(request).await, original);
    assert_eq!(before, Content::read(&stubs, "roadmap").await.unwrap());
    assert_eq!(before.points.len(), 20);

    let update = UpdateRequest {
        index: "roadmap".into(),
        ids: original.ids[..2].to_vec(),
        tags: vec![7],
        operation_id: "tag".into(),
        ..Default::default()
    };
    let updated = stubs.points.update(update.clone()).await.unwrap();
    assert_eq!(updated.get_ref().updated_count, 2);
    let again = stubs.points.update(update).await.unwrap();
    assert_eq!(again.into_inner(), updated.into_inner());

    let remove = RemoveRequest {
        index: "roadmap".into(),
        ids: original.ids.clone(),
        operation_id: "remove".into(),
        ..Default::default()
    };
    let removed = stubs.points.remove(remove.clone()).await.unwrap();
    assert_eq!(removed.get_ref().removed_count, 10);
    let again = stubs.points.remove(remove).await.unwrap();
    assert_eq!(again.into_inner(), removed.into_inner());
    let after = Content::read(&stubs, "roadmap").await.unwrap();
    assert_eq!((after.revision, after.points.len()), (4, 10));
}

#[tokio::test(flavor = "multi_thread")]
async fn twins_in_flight_take_effect_once() {
    let (server, stubs, mut states) = index().await;
    // On connections of their own, as planners in several processes would send them.
    let mut connections = Vec::new();
    for _ in 0..4 {
        connections.push(Stubs::connect(server.uri()).await);
    }
    for round in 0..20_u64 {
        let request = insert(&mut states, 100, &format!("round {round}"));
        let mut twins = JoinSet::new();
        for twin in 0..TWINS {
            let mut stubs = connections[twin % connections.len()].clone();
            let request = request.clone();
            twins.spawn(async move { stubs.insert(request).await });
        }
        let answers = twins.join_all().await;
        assert_eq!(number(&answers[0].revision), round + 1);
        assert!(answers.iter().all(|answer| *answer == answers[0]));
    }
    let content = Content::read(&stubs, "roadmap").await.unwrap();
    assert_eq!((content.revision, content.points.len()), (20, 2_000));
}

#[tokio::test]
async fn other_content_under_the_same_id_is_refused() {
    let (_server, mut stubs, mut states) = index().await;
    let request = insert(&mut states, 1, "taken");
    let stored = stubs.insert(request.clone()).await;
    let before = Content::read(&stubs, "roadmap").await.unwrap();

    let mut others = Vec::new();
    let other = insert(&mut states, 1, "taken");
    others.push(stubs.points.insert(other).await.unwrap_err());
    let mut tagged = request.clone();
    tagged.tags = vec![1];
    others.push(stubs.points.insert(tagged).await.unwrap_err());
    let remove = RemoveRequest {
        index: "roadmap".into(),
        ids: stored.ids,
        operation_id: "taken".into(),
        ..Default::default()
    };
    others.push(stubs.points.remove(remove).await.unwrap_err());
    for status in &others {
        let refusal = Refusal::of(status);
        assert_eq!(refusal.code, Code::InvalidArgument, "{refusal:?}");
        assert_eq!(refusal.fields[0].0, "operation_id");
    }
    assert_eq!(before, Content::read(&stubs, "roadmap").await.unwrap());
}

#[tokio::test]
async fn an_operation_belongs_to_the_uid_of_its_index() {
    let (_server, mut stubs, mut states) = index().await;
    let request = insert(&mut states, 3, "first");
    let original = stubs.insert(request.clone()).await;
    stubs.delete("roadmap").await;
    let created = stubs.create("roadmap", "R3*SO3:0.15").await;
    let uid = created.revision.unwrap().uid;
    assert_ne!(uid, original.revision.unwrap().uid);
    let anew = stubs.insert(request).await;
    assert_eq!(anew.revision, revision(&uid, 1));
    assert_eq!(stubs.describe("roadmap").await.point_count, 3);
}
