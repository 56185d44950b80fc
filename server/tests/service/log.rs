//! A client that missed mutations asks for them, and receives what a watch would have sent.

use prost::Message;
use wayfold_proto::v1::{self, ResetReason};
use wayfold_server::service::{Code, Limits, Service};

use crate::support::*;

/// The mutations that a watch sends up to `revision`.
async fn watched(service: &Service, uid: &str, revision: u64) -> Vec<v1::Mutation> {
    let mut watch = service.watch(&CALL, watching(uid, 0)).await.unwrap();
    let mut mutations: Vec<v1::Mutation> = Vec::new();
    while mutations
        .last()
        .is_none_or(|last| last.revision.number() < revision || last.continued)
    {
        mutations.extend(watch.next().await.unwrap().unwrap().mutations);
    }
    mutations
}

#[tokio::test]
async fn answers_that_fit_amount_to_what_a_watch_tells() {
    let limits = Limits {
        max_answer_bytes: 8_000,
        max_payload_bytes: 100,
        ..Limits::default()
    };
    let (service, uid) = arm_with("R3", limits).await;
    for seed in 0..40 {
        let request = v1::InsertRequest {
            payloads: vec![vec![seed as u8; 100].into(); 9],
            ..insertion(&cube(seed, 9), &[])
        };
        service.insert(&CALL, request).await.unwrap();
        if seed % 3 == 0 {
            service.remove(&CALL, removal(&[seed * 9])).await.unwrap();
        }
    }
    let last = info(&service, "arm").await.revision.number();
    let mut received: Vec<v1::Mutation> = Vec::new();
    let mut answers = 0;
    loop {
        let from = received
            .last()
            .map_or(0, |mutation| mutation.revision.number());
        let answer = service.log(&CALL, watching(&uid, from)).await.unwrap();
        assert_eq!(
            (answer.revision.uid(), answer.revision.number()),
            (uid.clone(), last)
        );
        assert!(answer.encoded_len() <= 8_000, "{}", answer.encoded_len());
        if answer.mutations.is_empty() {
            break;
        }
        answers += 1;
        received.extend(answer.mutations);
    }
    assert!(answers > 3, "{answers}");
    assert!(received.iter().all(|mutation| !mutation.continued));
    assert_eq!(received, watched(&service, &uid, last).await);
}

#[tokio::test]
async fn it_waits_for_nothing_and_says_when_it_can_not_tell() {
    let (service, uid) = arm("R1").await;
    let newest = v1::WatchRequest {
        after_revision: None,
        ..watching("", 0)
    };
    let head = service.log(&CALL, newest.clone()).await.unwrap();
    assert_eq!(head.revision, revision(&uid, 0));
    let request = insertion(&[[1.0]], &[3]);
    service.insert(&CALL, request).await.unwrap();
    for (request, mutations) in [
        (newest, 0),
        (watching(&uid, 0), 1),
        (watching(&uid, 1), 0),
        (watching(&uid, 9), 0),
    ] {
        let answer = service.log(&CALL, request).await.unwrap();
        assert_eq!(
            (answer.revision.number(), answer.mutations.len()),
            (1, mutations)
        );
    }
    let strange = service.log(&CALL, watching("strange", 0)).await.unwrap();
    assert_eq!(strange.reset(), ResetReason::UidChanged);
    assert_eq!(strange.revision.uid(), uid);
    let unnamed = service.log(&CALL, watching("", 0)).await;
    assert_eq!(
        refusal(unnamed),
        (
            Code::InvalidArgument,
            "REQUIRED",
            "after_revision.uid".into()
        )
    );
}

#[tokio::test]
async fn a_mutation_that_no_answer_holds_is_refused_and_not_cut() {
    let limits = Limits {
        max_answer_bytes: 4_000,
        max_payload_bytes: 100,
        ..Limits::default()
    };
    let (service, uid) = arm_with("R3", limits).await;
    for rows in [1, 100, 1] {
        let request = insertion(&cube(rows, rows as usize), &[]);
        service.insert(&CALL, request).await.unwrap();
    }
    let before = service.log(&CALL, watching(&uid, 0)).await.unwrap();
    assert_eq!(before.mutations.len(), 1);
    let refused = refusal(service.log(&CALL, watching(&uid, 1)).await);
    assert_eq!(
        (refused.0, refused.1),
        (Code::ResourceExhausted, "LIMIT_EXCEEDED")
    );
    let behind = service.log(&CALL, watching(&uid, 2)).await.unwrap();
    assert_eq!(behind.mutations[0].revision.number(), 3);
}

#[tokio::test]
async fn subscribers_of_the_list_of_indices_receive_each_change() {
    let service = service();
    let mut catalog = service.watch_catalog().unwrap();
    assert!(catalog.changed().await.unwrap().is_empty());
    let uid = create(&service, "arm", "R1").await;
    let now = catalog.changed().await.unwrap();
    assert_eq!(
        now.into_iter().collect::<Vec<_>>(),
        [("arm".to_owned(), uid.clone())]
    );
    delete(&service, "arm").await;
    let other = create(&service, "arm", "R1").await;
    assert_ne!(uid, other);
    assert_eq!(catalog.changed().await.unwrap()["arm"], other);
}
