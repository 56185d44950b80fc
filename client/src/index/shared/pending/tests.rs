//! Lost answers, reloads and refusals, without a server.

mod division;
mod meanwhile;

use super::{batching::LARGE_BATCH_STEPS, *};
use crate::{
    Code, Meanwhile, Refusal,
    index::{
        local::{LocalPoints, NewRow},
        shared::meanwhile::Reloaded,
    },
};
use wayfold_index::{Forest, ForestOptions, Points, Search, Space};

fn space() -> Space {
    "R1".parse().expect("a space")
}

fn block(first_id: u64, id_count: u64) -> Option<v1::IdBlock> {
    Some(v1::IdBlock { first_id, id_count })
}

/// The pending writes of session 1, with ids from 100 on, and an empty copy.
fn pending_writes() -> (PendingWrites, LocalPoints) {
    let mut writes = PendingWrites::new(1);
    writes.open(1, block(100, 50));
    (writes, LocalPoints::new(&space()))
}

fn put(tag: u64, row: &[f64]) -> Step<'_> {
    Step::Put {
        tag,
        row,
        payload: &[],
    }
}

fn insert(writes: &mut PendingWrites, points: &mut LocalPoints, row: f64) -> u64 {
    let id = writes.ids.next().expect("an id");
    writes.insert(id, &put(0, &[row]), points).expect("a state");
    id
}

/// Another writer's record.
fn foreign(writes: &mut PendingWrites, points: &mut LocalPoints, id: u64, tag: u64, row: f64) {
    let row = [row];
    let stored = NewRow {
        id,
        tag,
        row: &row,
        is_new: true,
    };
    writes
        .apply([stored].into_iter(), &[], points)
        .expect("a state");
}

/// A copy that was read again at a revision, which also stored the states of these points.
fn reload(
    writes: &mut PendingWrites,
    points: &mut LocalPoints,
    revision: u64,
    rows: &[(u64, u64, f64)],
) -> Vec<Meanwhile> {
    reload_at(writes, points, revision, rows, revision)
}

/// A copy that was read again at a revision, with points whose states were stored at another one.
fn reload_at(
    writes: &mut PendingWrites,
    points: &mut LocalPoints,
    revision: u64,
    rows: &[(u64, u64, f64)],
    stored_at: u64,
) -> Vec<Meanwhile> {
    let change = points.read_revision().0 + 1_000;
    let mut forest = Forest::new(space(), ForestOptions::for_space(&space()));
    let mut table = Points::new(1);
    for &(id, tag, row) in rows {
        table.push(id, tag, change, &[row]);
    }
    forest.apply(change, &table, &[]).expect("states");
    let old = points.forest.snapshot();
    let changes = Reloaded::between(&old, &forest.snapshot(), &vec![stored_at; rows.len()]);
    points.replace(forest);
    let answerable = writes.reloaded(revision, &changes, points).expect("a copy");
    let space = space();
    let answers = answerable.iter().map(|it| it.answers(&space));
    answers.flatten().collect()
}

fn shown(points: &LocalPoints, id: u64) -> Option<(u64, f64)> {
    points.get(id).map(|point| (point.tag, point.row[0]))
}

#[test]
fn a_repeated_request_is_the_same() {
    let (mut writes, mut points) = pending_writes();
    insert(&mut writes, &mut points, 1.0);
    let first = writes.next(1, 0);
    insert(&mut writes, &mut points, 2.0);
    assert_eq!(writes.next(1, 65_536), first);
    assert_eq!(first.map(|request| request.ids), Some(vec![100]));
}

#[test]
fn a_batch_is_worth_a_call_once_it_has_many_writes_or_another_waits_behind_it() {
    let (mut writes, mut points) = pending_writes();
    writes.reserve(block(200, 100));
    assert!(!writes.is_next_large());
    for step in 1..=LARGE_BATCH_STEPS {
        insert(&mut writes, &mut points, step as f64);
        assert_eq!(writes.is_next_large(), step == LARGE_BATCH_STEPS);
    }
    // It is under way.
    writes.next(1, 0);
    assert!(!writes.is_next_large());
    writes.limits.max_rows_per_call = 2;
    for step in 1..=3 {
        insert(&mut writes, &mut points, step as f64);
        assert_eq!(writes.is_next_large(), step == 3);
    }
}

#[test]
fn a_reload_confirms_the_batches_that_it_holds() {
    let (mut writes, mut points) = pending_writes();
    foreign(&mut writes, &mut points, 5, 0, 0.5);
    writes
        .change(5, &Step::SetTag(1), &mut points)
        .expect("a point");
    writes.next(1, 0).expect("a batch");
    writes.acknowledge(1, 10, 1, &mut points).expect("a batch");
    assert_eq!(shown(&points, 5), Some((1, 0.5)));
    // Another writer has set the tag 2 after it.
    reload(&mut writes, &mut points, 20, &[(5, 2, 0.5)]);
    assert_eq!(shown(&points, 5), Some((2, 0.5)));
    assert_eq!(writes.bytes, 0);
}

/// The answer to a batch arrives after the reload that holds it.
#[test]
fn an_answer_after_a_reload_confirms_its_batch_and_those_before_it() {
    let (mut writes, mut points) = pending_writes();
    let first = insert(&mut writes, &mut points, 1.0);
    writes.next(1, 0).expect("a batch");
    reload(&mut writes, &mut points, 20, &[]);
    // Another writer removed the point before the reload. The copy does not know it yet.
    assert_eq!(shown(&points, first), Some((0, 1.0)));
    writes.acknowledge(1, 15, 20, &mut points).expect("a batch");
    assert_eq!(shown(&points, first), None);
    assert_eq!((writes.bytes, writes.resolved), (0, 1));
}

#[test]
fn a_batch_that_was_taken_waits_for_the_feed_after_a_refusal() {
    let (mut writes, mut points) = pending_writes();
    foreign(&mut writes, &mut points, 5, 0, 0.5);
    writes
        .change(5, &Step::Replace { row: &[1.0] }, &mut points)
        .expect("a point");
    writes.next(1, 0).expect("a batch");
    writes.acknowledge(1, 10, 1, &mut points).expect("a batch");
    let lost = insert(&mut writes, &mut points, 2.0);
    writes
        .change(5, &Step::Remove, &mut points)
        .expect("a point");
    writes
        .refuse(Arc::new(Error::Closed), &mut points)
        .expect("a copy");
    assert_eq!(shown(&points, lost), None);
    assert_eq!(shown(&points, 5), Some((0, 1.0)));
    // Revision 9, of another writer, and then the own revision 10.
    foreign(&mut writes, &mut points, 5, 0, 9.0);
    assert_eq!(shown(&points, 5), Some((0, 1.0)));
    assert!(writes.is_own(1));
    assert!(
        writes
            .confirm(1, 1, &mut points)
            .expect("a batch")
            .is_some()
    );
    assert_eq!(shown(&points, 5), Some((0, 1.0)));
    let unsent = writes.take_unsent();
    assert_eq!((unsent.len(), writes.bytes), (2, 0));
    // A batch that was given back is none of those that wait for the feed.
    assert!(
        writes
            .confirm(1, 2, &mut points)
            .expect("a batch")
            .is_none()
    );
}

#[test]
fn a_history_that_is_gone_leaves_no_session() {
    let (mut writes, mut points) = pending_writes();
    insert(&mut writes, &mut points, 1.0);
    writes
        .refuse(Arc::new(Error::Closed), &mut points)
        .expect("a copy");
    assert!(writes.is_own(1));
    writes.forget_history();
    assert!(!writes.is_own(1));
    assert_eq!(writes.take_unsent().len(), 1);
    assert_eq!(points.forest.len(), 0);
}

/// A point of an earlier session, whose batch the feed has not named yet, is changed in the next session.
#[test]
fn a_change_waits_for_the_insert_of_an_earlier_session() {
    let (mut writes, mut points) = pending_writes();
    let id = insert(&mut writes, &mut points, 1.0);
    writes.next(1, 0).expect("a batch");
    writes.acknowledge(1, 10, 9, &mut points).expect("a copy");
    let why = Arc::new(Error::Closed);
    writes.refuse(why, &mut points).expect("a copy");
    assert!(writes.take_unsent().is_empty());
    writes.open(2, None);
    let tag = Step::SetTag(5);
    writes.change(id, &tag, &mut points).expect("a copy");
    let named = writes.confirm(1, 1, &mut points).expect("a copy");
    assert!(named.is_some());
    assert_eq!(shown(&points, id), Some((5, 1.0)));
    // Another writer comes between.
    foreign(&mut writes, &mut points, id, 7, 2.0);
    assert_eq!(shown(&points, id), Some((5, 2.0)));
    writes.next(2, 0).expect("a batch");
    writes.confirm(2, 1, &mut points).expect("a copy");
    assert_eq!(shown(&points, id), Some((5, 2.0)));
}

/// The caller chose an id of a reserved block, and later ids of the block are pending.
#[test]
fn a_change_to_a_published_point_waits_for_no_insert() {
    let (mut writes, mut points) = pending_writes();
    foreign(&mut writes, &mut points, 120, 0, 1.0);
    writes.ids.next().expect("an id");
    insert(&mut writes, &mut points, 2.0);
    writes
        .change(120, &Step::SetTag(5), &mut points)
        .expect("a copy");
    writes.next(1, 0).expect("a batch");
    writes.confirm(1, 1, &mut points).expect("a copy");
    foreign(&mut writes, &mut points, 120, 7, 3.0);
    assert_eq!(shown(&points, 120), Some((7, 3.0)));
}

/// The writes that a refusal gave back are stored again before the next session is open, which reserves their ids.
#[test]
fn ids_that_the_caller_chose_between_sessions_are_not_given() {
    let (mut writes, mut points) = pending_writes();
    let why = Arc::new(Error::Closed);
    writes.refuse(why, &mut points).expect("a copy");
    writes.take_unsent();
    let own = put(0, &[1.0]);
    for id in [0, 3] {
        writes.ids.note_caller_id(id);
        writes.change(id, &own, &mut points).expect("a state");
    }
    writes.open(2, block(0, 5));
    let given: Vec<u64> = std::iter::from_fn(|| writes.ids.next()).collect();
    assert_eq!(given, [1, 2, 4]);
}

/// The writes that it gave back are stored again before the server is asked for its limits.
#[test]
fn batches_after_a_refusal_keep_to_the_lower_limit_that_it_names() {
    let (mut writes, mut points) = pending_writes();
    let metadata = [("limit", "max_rows_per_call"), ("value", "2")];
    let metadata = metadata.map(|(key, value)| (key.to_owned(), value.to_owned()));
    let refusal = Refusal {
        code: Code::ResourceExhausted,
        message: "too many rows".to_owned(),
        reason: "LIMIT_EXCEEDED".to_owned(),
        metadata: metadata.into(),
        fields: Vec::new(),
        ids: Vec::new(),
        retry_after: None,
        earlier: None,
    };
    let why = Arc::new(Error::Refused(Box::new(refusal)));
    writes.refuse(why, &mut points).expect("a copy");
    writes.take_unsent();
    writes.open(2, block(200, 50));
    for row in [1.0, 2.0, 3.0] {
        insert(&mut writes, &mut points, row);
    }
    let request = writes.next(2, 0).expect("a batch");
    assert_eq!(request.ids, [200, 201]);
}

#[test]
fn inserts_that_were_never_sent_are_no_rebased_points_after_a_reload() {
    let (mut writes, mut points) = pending_writes();
    let sent = insert(&mut writes, &mut points, 1.0);
    writes.next(1, 0).expect("a batch");
    let plain = insert(&mut writes, &mut points, 2.0);
    let tagged = insert(&mut writes, &mut points, 3.0);
    let tag = Step::SetTag(5);
    writes.change(tagged, &tag, &mut points).expect("a point");
    reload(&mut writes, &mut points, 20, &[]);
    let content = [sent, plain, tagged].map(|id| shown(&points, id));
    assert_eq!(content, [Some((0, 1.0)), Some((0, 2.0)), Some((5, 3.0))]);
    let rebased = [sent, plain, tagged].map(|id| writes.rebased.contains_key(&id));
    assert_eq!(rebased, [true, false, true]);
    let held: usize = writes.queue.iter().map(Batch::held_bytes).sum();
    assert_eq!((writes.bytes, writes.published_points), (held, 0));
    assert!(held > 3 * writes.rebased_step_bytes());
    for number in [1, 2] {
        writes.next(1, 0).expect("a batch");
        writes.confirm(1, number, &mut points).expect("a copy");
    }
    assert_eq!((points.forest.len(), writes.published_points), (3, 3));
    assert_eq!((writes.bytes, writes.rebased.len()), (0, 0));
}
