//! How pending writes are divided into batches.

use super::*;

#[test]
fn a_batch_sets_few_enough_tags_for_the_largest_payloads() {
    let (mut writes, mut points) = pending_writes();
    let id = insert(&mut writes, &mut points, 1.0);
    writes.set_limits(Limits {
        max_payload_bytes: 60 << 10,
        max_changed_point_bytes: 64 << 20,
        ..Limits::NONE
    });
    assert_eq!(writes.max_updates(), 1024);
    for tag in 0..=1024 {
        let set = writes.change(id, &Step::SetTag(tag), &mut points);
        set.expect("a tag");
    }
    let sizes: Vec<_> = writes.queue.iter().map(Batch::len).collect();
    assert_eq!(sizes, [1 + 1024, 1]);
}

/// The server may reserve an id again if no batch left a point stored under it. Lower limits divide the batches again.
#[test]
fn no_batch_removes_a_point_that_it_stores_under_an_id_of_the_caller() {
    let (mut writes, mut points) = pending_writes();
    let (own, remove) = (put(0, &[1.0]), Step::Remove);
    for step in [&own, &remove, &own] {
        writes.change(150, step, &mut points).expect("a state");
    }
    // The server has counted this id since it reserved it.
    let assigned = insert(&mut writes, &mut points, 2.0);
    writes
        .change(assigned, &remove, &mut points)
        .expect("a point");
    writes.set_limits(Limits {
        max_rows_per_call: 1_000,
        ..writes.limits
    });
    let expected = [vec![150], vec![150, 150, assigned, assigned]];
    for (number, ids) in (1..).zip(expected) {
        let request = writes.next(1, 0).expect("a batch");
        assert_eq!((request.batch, request.ids), (number, ids));
        writes.confirm(1, number, &mut points).expect("a copy");
    }
    assert_eq!(writes.next(1, 0), None);
}

/// The batch under way, a search, a point that others may change, and an own point that is changed.
#[test]
fn batches_that_were_never_sent_are_divided_by_lower_limits() {
    let (mut writes, mut points) = pending_writes();
    insert(&mut writes, &mut points, 1.0);
    let sent = writes.next(1, 0);
    let ids = [2.0, 3.0, 4.0].map(|row| insert(&mut writes, &mut points, row));
    let change = points.read_revision().0;
    writes.note_search(ids[2], &[4.0], &Search::nearest_k(1).into(), &[], change);
    let own = put(7, &[5.0]);
    writes.change(9, &own, &mut points).expect("a state");
    let tag = Step::SetTag(5);
    writes.change(ids[0], &tag, &mut points).expect("a point");
    writes.set_limits(Limits {
        max_rows_per_call: 2,
        ..writes.limits
    });
    let held: usize = writes.queue.iter().map(Batch::held_bytes).sum();
    assert_eq!((writes.bytes, writes.written), (held, 6));
    assert_eq!(writes.next(1, 0), sent);
    assert!(writes.is_pending_insert(ids[2]) && !writes.is_pending_insert(9));
    writes.confirm(1, 1, &mut points).expect("a copy");
    let expected = [vec![ids[0], ids[1]], vec![ids[2], 9], vec![ids[0]]];
    for (number, ids) in (2..).zip(expected) {
        let request = writes.next(1, 0).expect("a batch");
        assert_eq!((request.batch, request.ids), (number, ids));
        writes
            .acknowledge(number, number, 0, &mut points)
            .expect("a batch");
    }
    let answered = [2, 3, 4].map(|number| {
        let named = writes.confirm(1, number, &mut points).expect("a copy");
        named.expect("an own batch").len()
    });
    assert_eq!(answered, [0, 1, 0]);
    assert_eq!((writes.bytes, writes.rebased.len()), (0, 0));
    assert_eq!(writes.published_points, points.forest.len());
    assert_eq!(
        [ids[0], 9].map(|id| shown(&points, id)),
        [Some((5, 2.0)), Some((7, 5.0))]
    );
}
