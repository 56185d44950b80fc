//! Reserved ids: only their session makes new points under them, and the server assigns none of them.

use super::*;

/// The reserved ids that a failed call names.
fn reserved<T: std::fmt::Debug>(answer: Result<T, Error>) -> Vec<u64> {
    let error = answer.unwrap_err();
    assert_eq!(error.code(), Code::AlreadyExists);
    match error {
        Error::IdsReserved { ids, .. } => ids,
        other => panic!("{other}"),
    }
}

#[tokio::test]
async fn only_the_session_stores_new_points_under_its_ids() {
    let (service, uid) = arm("R1").await;
    let (one, _) = open(&service, &uid, 4).await;
    let (other, _) = open(&service, &uid, 4).await;
    assert_eq!((one.first, other.first), (0, 4));

    let own_ids = insertion(&[[0.1], [0.2], [0.3]], &[1, 100, 5]);
    assert_eq!(reserved(service.insert(&CALL, own_ids).await), [1, 5]);
    let puts = [Put(1, 0.1), Put(100, 0.2), Put(2, 0.3), Put(4, 0.4)];
    assert_eq!(
        reserved(service.write(&CALL, batch(&other, 1, &puts)).await),
        [1, 2]
    );
    assert_eq!(stored(&service).await, [] as [u64; 0]);
    // A batch that leaves no new point under such an id is taken.
    write(&service, batch(&other, 1, &[Put(1, 0.1), Remove(1)])).await;

    write(&service, batch(&one, 1, &[Put(1, 0.1), Put(2, 0.2)])).await;
    // The points of a session can be replaced, tagged and removed by anyone.
    let replaced = v1::InsertRequest {
        on_conflict: v1::OnConflict::Replace.into(),
        ..insertion(&[[0.5]], &[1])
    };
    service.insert(&CALL, replaced).await.unwrap();
    let steps = [Put(1, 0.6), Tag(2, 3), Remove(2), Remove(1), Put(1, 0.7)];
    write(&service, batch(&other, 2, &steps)).await;
    let points = everything(&service).await.points.unwrap();
    assert_eq!((points.ids, points.states), (vec![1], states(&[[0.7]])));

    // A removal does not free the id.
    assert_eq!(
        reserved(service.insert(&CALL, insertion(&[[0.1]], &[2])).await),
        [2]
    );
    assert_eq!(
        reserved(service.write(&CALL, batch(&other, 3, &[Put(2, 0.1)])).await),
        [2]
    );
    write(&service, batch(&one, 2, &[Put(2, 0.1)])).await;
    assert_eq!(stored(&service).await, [1, 2]);
}

/// The second session's block divides the blocks of the first one.
#[tokio::test]
async fn blocks_grow_by_batches_and_no_id_is_reserved_twice_or_assigned() {
    let (service, uid) = arm("R1").await;
    let (one, _) = open(&service, &uid, 2).await;
    let mut expected = vec![one.id; 2];
    let (other, _) = open(&service, &uid, 1).await;
    expected.push(other.id);
    let sessions = [&one, &one, &other, &one, &other, &other];
    let mut newest = [0, 0];
    for (session, count) in sessions.into_iter().zip([3, 1, 2, 1, 1, 4]) {
        let number = &mut newest[usize::from(session.id == other.id)];
        *number += 1;
        let mut request = batch(session, *number, &[]);
        request.reserve_count = count;
        let block = write(&service, request).await.reserved.unwrap();
        assert_eq!(block.first_id, expected.len() as u64);
        assert_eq!(block.id_count, count);
        expected.extend((0..count).map(|_| session.id));
        let inserted = service.insert(&CALL, insertion(&[[0.5]], &[])).await;
        // Also an assigned id ends a block.
        assert_eq!(inserted.unwrap().ids, [expected.len() as u64]);
        expected.push(0);
    }
    for (id, owner) in (0..).zip(expected) {
        for session in [&one, &other] {
            let number = &mut newest[usize::from(session.id == other.id)];
            let steps = [Put(id, 1.0), Remove(id), Put(id, 2.0)];
            let request = batch(session, *number + 1, &steps);
            if owner == session.id || owner == 0 {
                write(&service, request).await;
                *number += 1;
                write(&service, batch(session, *number + 1, &[Remove(id)])).await;
                *number += 1;
            } else {
                assert_eq!(reserved(service.write(&CALL, request).await), [id]);
            }
        }
    }
}

/// A batch that stores a point under a high id reserves ids above it.
#[tokio::test]
async fn ids_end_below_2_to_the_63() {
    let (service, uid) = arm("R1").await;
    let (session, _) = open(&service, &uid, 0).await;
    let last = (1 << 63) - 1;
    let mut request = batch(&session, 1, &[Put(last - 3, 0.5)]);
    request.reserve_count = 4;
    let (code, reason, _) = refusal(service.write(&CALL, request.clone()).await);
    assert_eq!((code, reason), (Code::ResourceExhausted, "IDS_EXHAUSTED"));
    assert_eq!(stored(&service).await, [] as [u64; 0]);
    request.reserve_count = 2;
    let block = write(&service, request).await.reserved.unwrap();
    assert_eq!((block.first_id, block.id_count), (last - 2, 2));

    let refused = refusal(service.open_session(&CALL, opening(2)).await);
    assert_eq!((refused.0, refused.1), (code, reason));
    let (_, opened) = open(&service, &uid, 1).await;
    assert_eq!(opened.reserved.unwrap().first_id, last);
    let refused = refusal(service.open_session(&CALL, opening(1)).await);
    assert_eq!((refused.0, refused.1), (code, reason));
    open(&service, &uid, 0).await;
    let refused = refusal(service.insert(&CALL, insertion(&[[0.5]], &[])).await);
    assert_eq!((refused.0, refused.1), (code, reason));
    write(&service, batch(&session, 2, &[Put(last - 1, 0.5)])).await;
    assert_eq!(stored(&service).await, [last - 3, last - 1]);
}
