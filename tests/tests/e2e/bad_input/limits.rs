//! A message that is too large is refused with the limit's name and value, never cut.

use std::fs;

use tonic::Code::ResourceExhausted;
use wayfold_proto::v1::{
    CreateIndexRequest, GetRequest, InsertRequest, KnnRequest, QueryRequest, RemoveRequest,
    create_index_request::SpaceForm, knn_request::Count, query_request::Reach,
};
use wayfold_tests::{Refusal, k_nearest, row_states, server};

use super::{Bench, INDEX, good_row};

const SETTINGS: &str = "
[grpc]
max_message_bytes = 100_000
[limits]
rows_per_call = 500
ids_per_call = 50
k = 40
answer_bytes = 4_000
indexes = 3
";

/// A bench whose server has small limits.
async fn bench() -> Bench {
    let settings = tempfile::NamedTempFile::new().unwrap();
    fs::write(settings.path(), SETTINGS).unwrap();
    let path = settings.path().to_str().unwrap();
    Bench::on(server!("--config", path)).await
}

fn rows(count: usize) -> Option<wayfold_proto::v1::States> {
    Some(row_states(&good_row().repeat(count), 7))
}

fn names(refusal: &Refusal, limit: &str, value: i64) {
    let quota = refusal.details.quota_failure().unwrap();
    let quota = &quota.violations[0];
    assert!(quota.subject.contains(limit), "{quota:?}");
    assert_eq!(quota.quota_value, value);
    let message = &refusal.message;
    assert!(message.contains(&value.to_string()), "{message}");
}

#[tokio::test]
async fn calls_beyond_a_limit_are_refused() {
    let bench = bench().await;
    let mut stub = bench.stubs.points.clone();
    let refused = (ResourceExhausted, "LIMIT_EXCEEDED", "");
    let insert = |count| InsertRequest {
        index: INDEX.into(),
        states: rows(count),
        ..Default::default()
    };
    let knn = |count, k| KnnRequest {
        index: INDEX.into(),
        states: rows(count),
        count: Some(Count::K(k)),
        ..Default::default()
    };

    // 2,000 rows of 56 bytes.
    let answer = stub.insert(insert(2_000)).await;
    let refusal = bench.refused("an oversize message", answer, refused).await;
    names(&refusal, "max_message_bytes", 100_000);

    let answer = stub.insert(insert(501)).await;
    let refusal = bench
        .refused("too many rows to insert", answer, refused)
        .await;
    names(&refusal, "rows_per_call", 500);
    let answer = stub.knn(knn(501, 1)).await;
    let refusal = bench.refused("too many states", answer, refused).await;
    names(&refusal, "rows_per_call", 500);

    let answer = stub.knn(knn(1, 41)).await;
    let refusal = bench.refused("a large k", answer, refused).await;
    names(&refusal, "k", 40);
    let near = InsertRequest {
        neighbors: Some(k_nearest(41)),
        ..insert(1)
    };
    let answer = stub.insert(near).await;
    let refusal = bench
        .refused("a large k of an insert", answer, refused)
        .await;
    names(&refusal, "k", 40);

    let get = GetRequest {
        index: INDEX.into(),
        ids: (0..51).collect(),
        ..Default::default()
    };
    let answer = stub.get(get).await;
    let refusal = bench.refused("too many ids to get", answer, refused).await;
    names(&refusal, "ids_per_call", 50);
    let remove = RemoveRequest {
        index: INDEX.into(),
        ids: (0..51).collect(),
        ..Default::default()
    };
    let answer = stub.remove(remove).await;
    let refusal = bench
        .refused("too many ids to remove", answer, refused)
        .await;
    names(&refusal, "ids_per_call", 50);

    // Three neighbours for each of 200 states: 16 bytes each.
    let answer = stub.knn(knn(200, 3)).await;
    let refusal = bench.refused("an oversize answer", answer, refused).await;
    names(&refusal, "answer_bytes", 4_000);
    let query = QueryRequest {
        index: INDEX.into(),
        states: rows(200),
        reach: Some(Reach::Radius(1.0)),
        ..Default::default()
    };
    let answer = stub.query(query).await;
    let refusal = bench.refused("an oversize answer", answer, refused).await;
    names(&refusal, "answer_bytes", 4_000);
    // An insert whose answer would be too large has not inserted.
    let near = InsertRequest {
        neighbors: Some(k_nearest(40)),
        ..insert(200)
    };
    let answer = stub.insert(near).await;
    let refusal = bench
        .refused("an insert's oversize answer", answer, refused)
        .await;
    names(&refusal, "answer_bytes", 4_000);
}

#[tokio::test]
async fn a_server_holds_as_many_indices_as_it_may() {
    let bench = bench().await;
    let mut stub = bench.stubs.indexes.clone();
    let create = |name: &str| CreateIndexRequest {
        name: name.into(),
        space_form: Some(SpaceForm::SpaceText("R2".into())),
    };
    for name in ["b", "c"] {
        stub.create_index(create(name)).await.unwrap();
    }
    let answer = stub.create_index(create("d")).await;
    let refused = (ResourceExhausted, "LIMIT_EXCEEDED", "");
    let refusal = bench.refused("a fourth index", answer, refused).await;
    names(&refusal, "indexes", 3);
    assert!(
        !stub
            .create_index(create("c"))
            .await
            .unwrap()
            .into_inner()
            .created
    );
}

#[tokio::test]
async fn stock_limits_let_an_answer_through_that_a_stock_client_takes() {
    let bench = Bench::new().await;
    let mut stub = bench.stubs.points.clone();
    let query = |count| QueryRequest {
        index: INDEX.into(),
        states: rows(count),
        reach: Some(Reach::Radius(1.0)),
        ..Default::default()
    };
    // Three neighbours of 16 bytes and a count: 80,000 states are answered in 3.9 MB, 90,000 would take 4.4 MB.
    let answer = stub.query(query(80_000)).await.unwrap().into_inner();
    assert_eq!(answer.neighbors.unwrap().ids.len(), 240_000);
    let answer = stub.query(query(90_000)).await;
    let refused = (ResourceExhausted, "LIMIT_EXCEEDED", "");
    bench.refused("an oversize answer", answer, refused).await;
}
