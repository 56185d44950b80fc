//! Lost answers, reloads and refusals, without a server.

mod meanwhile;

use super::*;
use crate::{
    Meanwhile,
    index::local::{LocalPoints, NewRow},
};
use wayfold_index::{Forest, ForestOptions, Points, Search, Space};

fn space() -> Space {
    "R1".parse().expect("a space")
}

fn block(first_id: u64, id_count: u64) -> Option<v1::IdBlock> {
    Some(v1::IdBlock { first_id, id_count })
}

/// A writer in session 1, with ids from 100 on, and an empty copy.
fn writer() -> (Writer, LocalPoints) {
    let mut writer = Writer::new(1);
    writer.open(1, block(100, 50));
    (writer, LocalPoints::new(&space()))
}

fn put(tag: u64, row: &[f64]) -> Step<'_> {
    Step::Put {
        tag,
        row,
        payload: &[],
    }
}

fn insert(writer: &mut Writer, points: &mut LocalPoints, row: f64) -> u64 {
    let id = writer.ids.next().expect("an id");
    writer.insert(id, &put(0, &[row]), points).expect("a state");
    id
}

/// Another writer's record.
fn foreign(writer: &mut Writer, points: &mut LocalPoints, id: u64, tag: u64, row: f64) {
    let row = [row];
    let stored = NewRow {
        id,
        tag,
        row: &row,
        is_new: true,
    };
    writer
        .apply([stored].into_iter(), &[], points)
        .expect("a state");
}

/// A copy that was read again, with these points.
fn reload(writer: &mut Writer, points: &mut LocalPoints, revision: u64, rows: &[(u64, u64, f64)]) {
    let at = points.read_revision().0 + 1_000;
    let mut forest = Forest::new(space(), ForestOptions::for_space(&space()));
    let mut table = Points::new(1);
    for &(id, tag, row) in rows {
        table.push(id, tag, at, &[row]);
    }
    forest.apply(at, &table, &[]).expect("states");
    points.replace(forest);
    writer.reloaded(revision, points).expect("a copy");
}

fn shown(points: &LocalPoints, id: u64) -> Option<(u64, f64)> {
    points.get(id).map(|point| (point.tag, point.row[0]))
}

#[test]
fn a_repeated_request_is_the_same() {
    let (mut writer, mut points) = writer();
    insert(&mut writer, &mut points, 1.0);
    let first = writer.next(1, 0);
    insert(&mut writer, &mut points, 2.0);
    assert_eq!(writer.next(1, 65_536), first);
    assert_eq!(first.map(|request| request.ids), Some(vec![100]));
}

#[test]
fn a_reload_settles_the_batches_that_it_holds() {
    let (mut writer, mut points) = writer();
    foreign(&mut writer, &mut points, 5, 0, 0.5);
    writer
        .change(5, &Step::SetTag(1), &mut points)
        .expect("a point");
    writer.next(1, 0).expect("a batch");
    writer.acknowledge(1, 10, 1, &mut points).expect("a batch");
    assert_eq!(shown(&points, 5), Some((1, 0.5)));
    // Another writer has set the tag 2 after it.
    reload(&mut writer, &mut points, 20, &[(5, 2, 0.5)]);
    assert_eq!(shown(&points, 5), Some((2, 0.5)));
    assert_eq!(writer.bytes, 0);
}

/// The answer to a batch arrives after the reload that holds it.
#[test]
fn an_answer_after_a_reload_settles_its_batch_and_those_before_it() {
    let (mut writer, mut points) = writer();
    let first = insert(&mut writer, &mut points, 1.0);
    writer.next(1, 0).expect("a batch");
    reload(&mut writer, &mut points, 20, &[]);
    // Another writer removed the point before the reload, but nobody knows yet.
    assert_eq!(shown(&points, first), Some((0, 1.0)));
    writer.acknowledge(1, 15, 20, &mut points).expect("a batch");
    assert_eq!(shown(&points, first), None);
    assert_eq!((writer.bytes, writer.settled), (0, 1));
}

#[test]
fn a_batch_that_was_taken_waits_for_the_feed_after_a_refusal() {
    let (mut writer, mut points) = writer();
    foreign(&mut writer, &mut points, 5, 0, 0.5);
    writer
        .change(5, &Step::Replace { row: &[1.0] }, &mut points)
        .expect("a point");
    writer.next(1, 0).expect("a batch");
    writer.acknowledge(1, 10, 1, &mut points).expect("a batch");
    let lost = insert(&mut writer, &mut points, 2.0);
    writer
        .change(5, &Step::Remove, &mut points)
        .expect("a point");
    writer
        .refuse(Arc::new(Error::Closed), &mut points)
        .expect("a copy");
    assert_eq!(shown(&points, lost), None);
    assert_eq!(shown(&points, 5), Some((0, 1.0)));
    // Revision 9, of another writer, and then the own revision 10.
    foreign(&mut writer, &mut points, 5, 0, 9.0);
    assert_eq!(shown(&points, 5), Some((0, 1.0)));
    assert!(writer.is_own(1));
    assert!(
        writer
            .confirm(1, 1, &mut points)
            .expect("a batch")
            .is_some()
    );
    assert_eq!(shown(&points, 5), Some((0, 1.0)));
    let unsent = writer.take_unsent();
    assert_eq!((unsent.len(), writer.bytes), (2, 0));
    // A batch that was given back is none of those the writer waits for.
    assert!(
        writer
            .confirm(1, 2, &mut points)
            .expect("a batch")
            .is_none()
    );
}

#[test]
fn a_history_that_is_gone_leaves_no_session() {
    let (mut writer, mut points) = writer();
    insert(&mut writer, &mut points, 1.0);
    writer
        .refuse(Arc::new(Error::Closed), &mut points)
        .expect("a copy");
    assert!(writer.is_own(1));
    writer.forget_history();
    assert!(!writer.is_own(1));
    assert_eq!(writer.take_unsent().len(), 1);
    assert_eq!(points.forest.len(), 0);
}

/// A point of an earlier session, whose batch the feed has not named yet, is changed in the next session.
#[test]
fn a_change_waits_for_the_insert_of_an_earlier_session() {
    let (mut writer, mut points) = writer();
    let id = insert(&mut writer, &mut points, 1.0);
    writer.next(1, 0).expect("a batch");
    writer.acknowledge(1, 10, 9, &mut points).expect("a copy");
    let why = Arc::new(Error::Closed);
    writer.refuse(why, &mut points).expect("a copy");
    assert!(writer.take_unsent().is_empty());
    writer.open(2, None);
    let tag = Step::SetTag(5);
    writer.change(id, &tag, &mut points).expect("a copy");
    let named = writer.confirm(1, 1, &mut points).expect("a copy");
    assert!(named.is_some());
    assert_eq!(shown(&points, id), Some((5, 1.0)));
    // Another writer comes between.
    foreign(&mut writer, &mut points, id, 7, 2.0);
    assert_eq!(shown(&points, id), Some((5, 2.0)));
    writer.next(2, 0).expect("a batch");
    writer.confirm(2, 1, &mut points).expect("a copy");
    assert_eq!(shown(&points, id), Some((5, 2.0)));
}

/// The caller gave an id of a reserved block, and later ids of the block are pending.
#[test]
fn a_change_to_a_published_point_waits_for_no_insert() {
    let (mut writer, mut points) = writer();
    foreign(&mut writer, &mut points, 120, 0, 1.0);
    writer.ids.next().expect("an id");
    insert(&mut writer, &mut points, 2.0);
    writer
        .change(120, &Step::SetTag(5), &mut points)
        .expect("a copy");
    writer.next(1, 0).expect("a batch");
    writer.confirm(1, 1, &mut points).expect("a copy");
    foreign(&mut writer, &mut points, 120, 7, 3.0);
    assert_eq!(shown(&points, 120), Some((7, 3.0)));
}

/// The writes that a refusal gave back are stored again before the next session is open, which reserves their ids.
#[test]
fn ids_that_the_caller_gave_between_sessions_are_not_given_again() {
    let (mut writer, mut points) = writer();
    let why = Arc::new(Error::Closed);
    writer.refuse(why, &mut points).expect("a copy");
    writer.take_unsent();
    let own = put(0, &[1.0]);
    for id in [0, 3] {
        writer.ids.give(id);
        writer.change(id, &own, &mut points).expect("a state");
    }
    writer.open(2, block(0, 5));
    let given: Vec<u64> = std::iter::from_fn(|| writer.ids.next()).collect();
    assert_eq!(given, [1, 2, 4]);
}
