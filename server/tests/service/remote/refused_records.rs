//! Values of records that the journal refused, and refusals by such values.

use std::sync::{Arc, atomic::Ordering::Relaxed};

use futures_util::FutureExt;
use tokio::task::yield_now;
use wayfold_proto::v1;
use wayfold_server::{
    log::{Catalogue, MemoryLog},
    service::{Code, Limits},
};

use super::{Stream, named_arm, points_at, server, server_over, settled};
use crate::support::*;

/// The same state with another payload.
fn replacing(payload: &'static str) -> v1::InsertRequest {
    v1::InsertRequest {
        payloads: vec![payload.into()],
        on_conflict: v1::OnConflict::Replace.into(),
        ..insertion(&[[1.0]], &[7])
    }
}

#[tokio::test(start_paused = true)]
async fn an_insert_forgets_the_payloads_of_refused_records() {
    let (stream, entry) = (Stream::new(14, 0.0), named_arm());
    let (one, _, journal) = server(&stream, &entry);
    let (other, ..) = server(&stream, &entry);
    one.insert(&CALL, replacing("old")).await.unwrap();
    points_at(&other, entry.uid, 1).await;
    let held = journal.hold().await;
    let mut calls = Vec::new();
    // The second one changes nothing, as long as the first is where it seems to be.
    for request in [insertion(&[[2.0]], &[8]), replacing("old")] {
        let service = one.clone();
        calls.push(tokio::spawn(
            async move { service.insert(&CALL, request).await },
        ));
        for _ in 0..20 {
            yield_now().await;
        }
    }
    other.insert(&CALL, replacing("new")).await.unwrap();
    drop(held);
    let mut last = 0;
    for call in calls {
        last = call.await.unwrap().unwrap().revision.number();
    }
    for service in [&one, &other] {
        let points = points_at(service, entry.uid, last).await;
        let at = points.ids.iter().position(|id| *id == 7).unwrap();
        assert_eq!(points.payloads[at], "old");
    }
}

/// A request under an operation id and one under a batch number, each while another request under the same one is pending,
/// which the journal refuses.
#[tokio::test(start_paused = true)]
async fn no_request_is_a_mismatch_with_a_refused_record() {
    let (stream, entry) = (Stream::new(19, 0.0), named_arm());
    let (one, registry, journal) = server(&stream, &entry);
    let (other, ..) = server(&stream, &entry);
    let opening = v1::OpenSessionRequest {
        index_name: "arm".into(),
        ..Default::default()
    };
    let session = one.open_session(&CALL, opening).await.unwrap().session;
    let hosted = registry.get("arm").unwrap();
    let insert = |state: f64| {
        let request = v1::InsertRequest {
            operation_id: "once".into(),
            ..insertion(&[[state]], &[])
        };
        let service = one.clone();
        async move { service.insert(&CALL, request).await.map(drop) }
    };
    let reserve = |reserve_count: u64| {
        let request = v1::WriteRequest {
            index_name: "arm".into(),
            uid: entry.uid.to_string(),
            session,
            batch: 1,
            reserve_count,
            ..Default::default()
        };
        let service = one.clone();
        async move { service.write(&CALL, request).await.map(drop) }
    };
    let pairs = [
        [insert(1.0).boxed(), insert(2.0).boxed()],
        [reserve(1).boxed(), reserve(2).boxed()],
    ];
    for [abandoned, rival] in pairs {
        let before = stream.newest(entry.uid).revision;
        let held = journal.hold().await;
        let abandoned = tokio::spawn(abandoned);
        for _ in 0..20 {
            yield_now().await;
        }
        // Its record stays pending, and nothing evaluates the call again.
        abandoned.abort();
        assert!(abandoned.await.unwrap_err().is_cancelled());
        let pending = hosted.write().await.unwrap().revision();
        assert_eq!(pending, before + 1);
        let rival = tokio::spawn(rival);
        for _ in 0..20 {
            yield_now().await;
        }
        let fenced = hosted.write().await.unwrap().revision();
        assert_eq!(fenced, before + 2);
        other.insert(&CALL, insertion(&[[9.0]], &[])).await.unwrap();
        drop(held);
        rival.await.unwrap().unwrap();
        // Each published record uses up a permit, and holding needs as many as before.
        journal.let_pass(100);
    }
    for mismatch in [insert(3.0).boxed(), reserve(3).boxed()] {
        let before = stream.records(entry.uid).len();
        let reason = mismatch.await.unwrap_err().reason();
        assert!(reason.ends_with("_MISMATCH"), "{reason}");
        assert_eq!(stream.records(entry.uid).len(), before + 1);
    }
    let found = settled(&stream, &entry, &[&one, &other]).await;
    assert_eq!(found.states.unwrap().coordinates, [9.0, 2.0, 9.0]);
}

/// A session may have ended in records that this server lacks.
#[tokio::test]
async fn a_full_table_of_sessions_is_refused_only_after_a_record() {
    let (stream, entry) = (Stream::new(15, 0.0), named_arm());
    let points = Arc::new(MemoryLog::new());
    points.create(entry.clone()).unwrap();
    let limits = Limits {
        max_sessions: 1,
        ..Limits::default()
    };
    let (service, ..) = server_over(&stream, points, limits);
    let request = || v1::OpenSessionRequest {
        index_name: "arm".into(),
        ..Default::default()
    };
    service.open_session(&CALL, request()).await.unwrap();
    let refused = service.open_session(&CALL, request()).await.unwrap_err();
    assert_eq!(refused.code(), Code::ResourceExhausted, "{refused}");
    assert_eq!(stream.records(entry.uid).len(), 2);
}

/// Other servers may have made the stored points smaller, which an update writes again.
#[tokio::test]
async fn a_record_that_the_journal_never_takes_is_refused_only_after_a_record() {
    let (stream, entry) = (Stream::new(18, 0.0), named_arm());
    let (service, _, journal) = server(&stream, &entry);
    let stored = insertion(&[[1.0], [2.0], [3.0]], &[1, 2, 3]);
    service.insert(&CALL, stored).await.unwrap();
    journal.max_points.store(2, Relaxed);
    let tagging = |ids: &[u64]| v1::UpdateRequest {
        tags: vec![7],
        operation_id: "tags".into(),
        ..updating(ids)
    };
    let refused = refusal(service.update(&CALL, tagging(&[1, 2, 3])).await);
    let expected = (Code::ResourceExhausted, "LIMIT_EXCEEDED", String::new());
    assert_eq!(refused, expected);
    let records = stream.records(entry.uid);
    assert_eq!(records.len(), 2);
    assert!(records[1].effects().is_empty());
    // The refused call has not used its operation id.
    let updated = service.update(&CALL, tagging(&[1, 2])).await.unwrap();
    assert_eq!((updated.updated_count, updated.revision.number()), (2, 3));
}

/// The answer may be small by what other servers have changed.
#[tokio::test]
async fn an_answer_that_is_too_large_is_refused_only_after_a_record() {
    let (stream, entry) = (Stream::new(17, 0.0), named_arm());
    let points = Arc::new(MemoryLog::new());
    points.create(entry.clone()).unwrap();
    let limits = Limits {
        max_answer_bytes: 456,
        ..Limits::default()
    };
    let (service, ..) = server_over(&stream, points, limits);
    for id in 0..12 {
        let request = v1::InsertRequest {
            payloads: vec![vec![1; 100].into()],
            ..insertion(&[[id as f64]], &[id])
        };
        service.insert(&CALL, request).await.unwrap();
    }
    // Too many neighbours, and too large payloads of some.
    for (k, with_payloads) in [(12, false), (3, true)] {
        let request = v1::InsertRequest {
            neighbor_spec: Some(v1::NeighborSpec {
                k_form: nearest(k),
                include: Some(v1::Include {
                    with_payloads,
                    ..Default::default()
                }),
                ..Default::default()
            }),
            ..insertion(&[[0.5]], &[])
        };
        let before = stream.records(entry.uid).len();
        let refused = service.insert(&CALL, request).await.unwrap_err();
        assert_eq!(refused.code(), Code::ResourceExhausted, "{refused}");
        assert_eq!(stream.records(entry.uid).len(), before + 1, "{refused}");
    }
}
