//! A batch that is refused changes nothing, and its number stays free.

use std::sync::Arc;

use wayfold_server::{
    log::MemoryLog,
    service::{Code, Limits},
};

use super::*;

#[tokio::test]
async fn wrong_fields_are_named_and_change_nothing() {
    let limits = Limits {
        max_payload_bytes: 3,
        ..Limits::default()
    };
    let (service, uid) = arm_with("R1", limits).await;
    let (session, _) = open(&service, &uid, 2).await;
    let good = batch(&session, 1, &[Put(session.first, 0.5), Remove(9)]);
    let broken = |change: fn(&mut v1::WriteRequest)| {
        let mut request = good.clone();
        change(&mut request);
        request
    };
    let cases = [
        (broken(|it| it.uid.clear()), "uid", "REQUIRED"),
        (broken(|it| it.kinds[1] = 0), "kinds[1]", "UNKNOWN_VALUE"),
        (broken(|it| it.kinds[0] = 6), "kinds[0]", "UNKNOWN_VALUE"),
        (broken(|it| it.ids[1] = 1 << 63), "ids[1]", "ID_TOO_LARGE"),
        (broken(|it| it.ids.truncate(1)), "ids", "COUNT"),
        (broken(|it| it.ids.push(4)), "ids", "COUNT"),
        (broken(|it| it.tags.truncate(1)), "tags", "COUNT"),
        (broken(|it| it.states = None), "states.row_count", "COUNT"),
        (
            broken(|it| it.states = states(&[[0.5], [0.6]])),
            "states.row_count",
            "COUNT",
        ),
        (
            broken(|it| it.states = states(&[[f64::NAN]])),
            "states[0].coords[0]",
            "NAN",
        ),
        (
            broken(|it| it.payloads = vec!["a".into(), "b".into()]),
            "payloads",
            "COUNT",
        ),
        (
            broken(|it| it.payloads = vec!["four".into()]),
            "payloads[0]",
            "PAYLOAD_TOO_LARGE",
        ),
    ];
    for (request, field, reason) in cases {
        let refused = refusal(service.write(&CALL, request.clone()).await);
        let expected = (Code::InvalidArgument, reason, field.to_owned());
        assert_eq!(refused, expected, "{request:?}");
    }
    assert_eq!(info(&service, "arm").await.revision.number(), 1);
    assert_eq!(write(&service, good).await.revision, revision(&uid, 2));
}

#[tokio::test]
async fn a_batch_out_of_order_or_of_no_session_is_refused() {
    let (service, uid) = arm("R1").await;
    let (session, _) = open(&service, &uid, 1).await;
    let put = [Put(session.first, 0.5)];
    for number in [0, 2, u64::MAX] {
        let refused = refused_batch(&service, batch(&session, number, &put)).await;
        let expected = (Code::FailedPrecondition, "BATCH_OUT_OF_ORDER");
        assert_eq!(refused, expected);
    }
    for id in [0, session.id + 1, u64::MAX] {
        let unknown = Opened {
            id,
            ..session.clone()
        };
        for number in [0, 1, u64::MAX] {
            let refused = refused_batch(&service, batch(&unknown, number, &put)).await;
            assert_eq!(refused, (Code::FailedPrecondition, "SESSION_ENDED"));
        }
    }
    let mut other = batch(&session, 1, &put);
    other.uid = "another".into();
    let mismatch = (Code::FailedPrecondition, "UID_MISMATCH");
    assert_eq!(refused_batch(&service, other).await, mismatch);
    assert_eq!(stored(&service).await, [] as [u64; 0]);
    write(&service, batch(&session, 1, &put)).await;
}

/// The first revision of the new index opens a session too, and its batches are not those of the old one.
#[tokio::test]
async fn a_session_ends_with_its_index() {
    let (service, uid) = arm("R1").await;
    let (session, _) = open(&service, &uid, 1).await;
    let first = batch(&session, 1, &[Put(session.first, 0.5)]);
    write(&service, first.clone()).await;
    delete(&service, "arm").await;
    let new = create(&service, "arm", "R1").await;
    let (reopened, _) = open(&service, &new, 1).await;
    assert_eq!(reopened.id, session.id);
    let mismatch = (Code::FailedPrecondition, "UID_MISMATCH");
    assert_eq!(refused_batch(&service, first).await, mismatch);
    assert_eq!(stored(&service).await, [] as [u64; 0]);
}

#[tokio::test]
async fn limits_are_named_with_their_values() {
    let limits = Limits {
        max_rows_per_call: 2,
        max_reserved_ids: 4,
        max_sessions: 2,
        ..Limits::default()
    };
    let (service, uid) = arm_with("R1", limits).await;
    let limit = |error: Error| match error {
        Error::LimitExceeded {
            limit,
            value,
            requested,
            ..
        } => (limit, value, requested),
        other => panic!("{other}"),
    };
    let too_many = service.open_session(&CALL, opening(5)).await.unwrap_err();
    assert_eq!(limit(too_many), ("max_reserved_ids", 4, 5));
    let (session, _) = open(&service, &uid, 4).await;
    open(&service, &uid, 0).await;
    let third = service.open_session(&CALL, opening(0)).await.unwrap_err();
    assert_eq!(limit(third), ("max_sessions", 2, 3));

    let mut greedy = batch(&session, 1, &[]);
    greedy.reserve_count = u64::MAX;
    let greedy = service.write(&CALL, greedy).await.unwrap_err();
    assert_eq!(limit(greedy), ("max_reserved_ids", 4, u64::MAX));
    let long = batch(&session, 1, &[Remove(1), Remove(1), Remove(1)]);
    let long = service.write(&CALL, long).await.unwrap_err();
    assert_eq!(limit(long), ("max_rows_per_call", 2, 3));
    assert_eq!(info(&service, "arm").await.revision.number(), 2);
    write(&service, batch(&session, 1, &[Remove(1), Remove(1)])).await;
}

#[tokio::test]
async fn a_quota_takes_a_batch_that_makes_the_index_smaller() {
    let log = Arc::new(MemoryLog::new());
    let service = service_with(log.clone(), Limits::default());
    let uid = create(&service, "arm", "R1").await;
    let rows: Vec<[f64; 1]> = (0..10).map(|row| [row.into()]).collect();
    let filled = service.insert(&CALL, insertion(&rows, &[])).await;
    filled.unwrap();
    let (session, _) = open(&service, &uid, 2).await;
    // An operator has lowered the quota.
    let limits = Limits {
        max_points_per_index: 5,
        ..Limits::default()
    };
    let service = restarted_with(log, options(), limits);
    let grows = batch(&session, 1, &[Put(session.first, 0.5)]);
    let refused = refused_batch(&service, grows).await;
    assert_eq!(refused, (Code::ResourceExhausted, "QUOTA_EXCEEDED"));
    let shrinks = [Remove(0), Remove(1), Put(session.first, 0.5)];
    write(&service, batch(&session, 1, &shrinks)).await;
    let moves = [Remove(2), Put(session.first + 1, 0.5)];
    write(&service, batch(&session, 2, &moves)).await;
    assert_eq!(stored(&service).await.len(), 9);
}
