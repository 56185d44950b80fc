//! Each request of a fixed script is lost, late, unanswered or fenced once. No caller sees it, and each call takes
//! effect once.

use tokio::{task::yield_now, try_join};

use super::{stream::Fault, *};
use crate::support::pass;

/// The time in which a script ends, by the paused clock.
const SCRIPT_TIME: Duration = Duration::from_secs(60);

/// Plain calls, calls with operation ids, calls that change nothing, `latest` reads and the calls of a session, some of them
/// at once; returns the points that they leave.
async fn script(service: &Service, uid: &str) -> BTreeMap<u64, f64> {
    let insert = |state: f64, operation_id: &str| {
        let request = v1::InsertRequest {
            operation_id: operation_id.into(),
            ..insertion(&[[state]], &[])
        };
        async move { service.insert(&CALL, request).await }
    };
    let mut expected = BTreeMap::new();
    let mut inserted = |answer: v1::InsertResponse, state: f64| {
        assert_eq!(expected.insert(answer.ids[0], state), None);
        answer.ids[0]
    };

    let three = try_join!(insert(1.0, ""), insert(2.0, ""), insert(3.0, "")).unwrap();
    let first = inserted(three.0, 1.0);
    let second = inserted(three.1, 2.0);
    inserted(three.2, 3.0);
    let (once, again) = try_join!(insert(4.0, "four"), insert(4.0, "four")).unwrap();
    assert_eq!(once, again);
    inserted(once.clone(), 4.0);
    let removed = service.remove(&CALL, removal(&[first])).await.unwrap();
    assert_eq!(removed.removed_count, 1);
    let last = inserted(insert(5.0, "five").await.unwrap(), 5.0);
    let removing = v1::RemoveRequest {
        operation_id: "remove".into(),
        ..removal(&[last])
    };
    let removed = service.remove(&CALL, removing.clone()).await.unwrap();
    assert_eq!(service.remove(&CALL, removing).await.unwrap(), removed);
    assert_eq!(insert(4.0, "four").await.unwrap(), once);

    let update = v1::UpdateRequest {
        tags: vec![4],
        operation_id: "update".into(),
        ..updating(&once.ids)
    };
    let updated = service.update(&CALL, update.clone()).await.unwrap();
    assert_eq!(updated.updated_count, 1);
    assert_eq!(service.update(&CALL, update).await.unwrap(), updated);
    let latest = v1::GetRequest {
        latest: true,
        ..getting(&once.ids)
    };
    let [read, twin] = [latest.clone(), latest].map(|latest| service.get(&CALL, latest));
    let (read, twin) = try_join!(read, twin).unwrap();
    assert_eq!(read.points.unwrap().tags, [4]);
    assert_eq!(twin.points.unwrap().tags, [4]);

    let unchanged = service.remove(&CALL, removal(&[first])).await.unwrap();
    assert_eq!(unchanged.missing_count, 1);
    let too_close = v1::InsertRequest {
        min_separation: 0.5,
        operation_id: "close".into(),
        ..insertion(&[[2.1]], &[])
    };
    let unchanged = service.insert(&CALL, too_close.clone()).await.unwrap();
    assert_eq!(unchanged.ids, [second]);
    service.remove(&CALL, removal(&[second])).await.unwrap();
    let again = service.insert(&CALL, too_close).await.unwrap();
    assert_eq!(again, unchanged);
    for removed in [first, second, last] {
        expected.remove(&removed).unwrap();
    }

    let opening = v1::OpenSessionRequest {
        index_name: "arm".into(),
        reserve_count: 2,
        ..Default::default()
    };
    let opened = service.open_session(&CALL, opening).await.unwrap();
    let ids = opened.reserved.unwrap();
    for (number, kind) in [
        (1, v1::StepKind::Put),
        (2, v1::StepKind::SetTag),
        (3, v1::StepKind::Put),
        (4, v1::StepKind::Remove),
    ] {
        let is_put = kind == v1::StepKind::Put;
        let id = ids.first_id + number / 3;
        let rows: &[[f64; 1]] = if is_put { &[[number as f64]] } else { &[] };
        let batch = v1::WriteRequest {
            index_name: "arm".into(),
            uid: uid.into(),
            session: opened.session,
            batch: number,
            kinds: vec![kind.into()],
            ids: vec![id],
            tags: vec![number],
            states: states(rows),
            ..Default::default()
        };
        let twins = [batch.clone(), batch].map(|batch| service.write(&CALL, batch));
        let [one, other] = twins;
        let (one, other) = try_join!(one, other).unwrap();
        assert_eq!(one, other);
        assert_eq!(one.missing_count, 0);
    }
    expected.insert(ids.first_id, 1.0);
    expected
}

/// The clock jumps ahead whenever no task can run.
#[tokio::test(start_paused = true)]
async fn no_caller_sees_the_fault_of_any_request() {
    for fault in [
        Fault::LostRequest,
        Fault::LateRequest,
        Fault::LostAnswer,
        Fault::Fence,
    ] {
        let mut tried = 0;
        for request in 0..100 {
            println!("{fault:?} at request {request}");
            let (stream, entry) = (Stream::failing_at(request, fault), named_arm());
            let (service, ..) = server(&stream, &entry);
            let uid = entry.uid.to_string();
            let script = timeout(SCRIPT_TIME, script(&service, &uid));
            let expected = script.await.expect("a call without an end");
            let found = settled(&stream, &entry, &[&service]).await;
            let rows = found.states.unwrap().coordinates;
            let found: BTreeMap<u64, f64> = found.ids.into_iter().zip(rows).collect();
            assert_eq!(found, expected);
            tried = request;
            if stream.requests() <= request {
                break;
            }
        }
        assert!((10..99).contains(&tried), "{tried} requests");
    }
}

/// The record after a lost one is refused, and no record may ever have its place.
#[tokio::test(start_paused = true)]
async fn a_refused_record_that_nobody_writes_again_does_not_close_the_index() {
    for fault in [Fault::LostRequest, Fault::LateRequest] {
        let (stream, entry) = (Stream::failing_at(0, fault), named_arm());
        let (service, _, journal) = server(&stream, &entry);
        let held = journal.hold().await;
        let mut calls = Vec::new();
        for state in [1.0, 2.0] {
            let (service, request) = (service.clone(), insertion(&[[state]], &[]));
            calls.push(tokio::spawn(
                async move { service.insert(&CALL, request).await },
            ));
            for _ in 0..20 {
                yield_now().await;
            }
        }
        for call in calls {
            call.abort();
            assert!(call.await.unwrap_err().is_cancelled());
        }
        drop(held);
        pass(SCRIPT_TIME).await;
        let inserted = service.insert(&CALL, insertion(&[[3.0]], &[])).await;
        assert_eq!(inserted.unwrap().revision.number(), 2, "{fault:?}");
        settled(&stream, &entry, &[&service]).await;
    }
}
