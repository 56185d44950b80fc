//! Answers stay below their limit, and the refusal of a request that exceeds a limit names the limit.

use bytes::Bytes;
use prost::Message;
use wayfold_proto::v1;
use wayfold_server::service::{Code, Error, Limits, Service};

use crate::support::*;

const ANSWER_BYTES: usize = 4000;

async fn small() -> Service {
    let limits = Limits {
        max_rows_per_call: 50,
        max_ids_per_call: 60,
        max_k: 40,
        max_answer_bytes: ANSWER_BYTES,
        max_indexes: 2,
        ..Limits::default()
    };
    let (service, _) = arm_with("R3", limits).await;
    service
}

fn exceeded<T: std::fmt::Debug>(answer: Result<T, Error>) -> (&'static str, u64) {
    match answer.unwrap_err() {
        Error::LimitExceeded { limit, value, .. } => (limit, value),
        other => panic!("{other}"),
    }
}

#[tokio::test]
async fn exceeding_a_limit_is_refused_with_its_name_and_value() {
    let service = small().await;
    let rows = cube(1, 51);
    assert_eq!(
        exceeded(service.insert(&CALL, insertion(&rows, &[])).await),
        ("max_rows_per_call", 50)
    );
    assert_eq!(
        exceeded(service.knn(&CALL, knn(&rows, 1)).await),
        ("max_rows_per_call", 50)
    );
    assert_eq!(
        exceeded(service.knn(&CALL, knn(&rows[..1], 41)).await),
        ("max_k", 40)
    );
    let neighbors = v1::InsertRequest {
        neighbor_spec: Some(v1::NeighborSpec {
            k_form: nearest(41),
            ..Default::default()
        }),
        ..insertion(&rows[..1], &[])
    };
    assert_eq!(
        exceeded(service.insert(&CALL, neighbors).await),
        ("max_k", 40)
    );
    let ids: Vec<u64> = (0..61).collect();
    assert_eq!(
        exceeded(service.get(&CALL, getting(&ids)).await),
        ("max_ids_per_call", 60)
    );
    assert_eq!(
        exceeded(service.remove(&CALL, removal(&ids)).await),
        ("max_ids_per_call", 60)
    );
    create(&service, "second", "R1").await;
    let third = service.create_index(&CALL, creation("third", "R1")).await;
    assert_eq!(exceeded(third), ("max_indexes", 2));
    // An existing index is still found.
    create(&service, "arm", "R3").await;
}

/// Fifty points with payloads, stored at a revision that takes two bytes.
async fn fill(service: &Service, rows: &[[f64; 3]]) {
    for _ in 0..100 {
        insert_rows(service, &[[0.0; 3]], &[77]).await;
        service.remove(&CALL, removal(&[77])).await.unwrap();
    }
    let request = v1::InsertRequest {
        payloads: (0..50).map(|at| vec![at; at as usize].into()).collect(),
        ..insertion(rows, &[])
    };
    service.insert(&CALL, request).await.unwrap();
}

/// An accepted answer fits, and a refused answer would hardly have fitted.
#[tokio::test]
async fn answers_of_every_size_up_to_the_limit() {
    let service = small().await;
    let (generous, _) = arm("R3").await;
    let rows = cube(1, 50);
    fill(&service, &rows).await;
    fill(&generous, &rows).await;

    let (mut accepted, mut refused) = (0, 0);
    for included in 0..16 {
        for k in 1..=40 {
            let request = v1::KnnRequest {
                include: Some(v1::Include {
                    with_states: included & 1 > 0,
                    with_tags: included & 2 > 0,
                    with_revisions: included & 4 > 0,
                    with_payloads: included & 8 > 0,
                }),
                ..knn(&rows[..12], k)
            };
            let whole = generous.knn(&CALL, request.clone()).await.unwrap();
            let size = whole.encoded_len();
            match service.knn(&CALL, request).await {
                Ok(answer) => {
                    assert_eq!(answer.neighbors, whole.neighbors);
                    assert!(size <= ANSWER_BYTES);
                    accepted += 1;
                }
                Err(error) => {
                    assert_eq!(error.code(), Code::ResourceExhausted);
                    assert!(size > ANSWER_BYTES - 400, "{size}");
                    refused += 1;
                }
            }
        }
    }
    assert!(accepted > 0 && refused > 0);
}

#[tokio::test]
async fn oversize_answers_of_every_verb_are_refused() {
    let service = small().await;
    for start in [0, 50, 100, 150, 200, 250] {
        let ids: Vec<u64> = (start..start + 50).collect();
        insert_rows(&service, &cube(start, 50), &ids).await;
    }
    let before = info(&service, "arm").await;
    let whole = v1::QueryRequest {
        index_name: "arm".into(),
        states: states(&[[0.5; 3]]),
        radius_form: within(f64::INFINITY),
        ..Default::default()
    };
    let refused = ("max_answer_bytes", ANSWER_BYTES as u64);
    assert_eq!(exceeded(service.query(&CALL, whole).await), refused);
    let update = v1::UpdateRequest {
        payloads: vec![Bytes::from(vec![1; 2000]); 3],
        ..updating(&[0, 1, 2])
    };
    service.update(&CALL, update).await.unwrap();
    assert_eq!(
        exceeded(service.get(&CALL, getting(&[0, 1, 2])).await),
        refused
    );
    assert_eq!(
        service
            .get(&CALL, getting(&[0]))
            .await
            .unwrap()
            .revision
            .number(),
        before.revision.number() + 1
    );

    // An insert is refused before anything is stored.
    let request = v1::InsertRequest {
        neighbor_spec: Some(v1::NeighborSpec {
            k_form: nearest(30),
            ..Default::default()
        }),
        ..insertion(&cube(9, 20), &[])
    };
    assert_eq!(exceeded(service.insert(&CALL, request).await), refused);
    let after = info(&service, "arm").await;
    assert_eq!(
        (after.revision.number(), after.point_count),
        (before.revision.number() + 1, before.point_count)
    );
}

#[tokio::test]
async fn an_insert_whose_outcomes_alone_are_too_many_is_refused() {
    let limits = Limits {
        max_answer_bytes: 600,
        ..Limits::default()
    };
    let (service, _) = arm_with("R3", limits).await;
    insert_rows(&service, &cube(1, 30), &[]).await;
    let many = service.insert(&CALL, insertion(&cube(2, 60), &[])).await;
    assert_eq!(exceeded(many), ("max_answer_bytes", 600));
    assert_eq!(info(&service, "arm").await.point_count, 30);
}
