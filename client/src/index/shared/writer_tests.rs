//! Lost answers, reloads and refusals, without a server.

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

/// Inserts a point at 0, whose search found the point 1 at distance 1.
fn insert_near_1(writer: &mut Writer, points: &mut LocalPoints, search: &Search<'_>) {
    let id = insert(writer, points, 0.0);
    let found = [Neighbor {
        distance: 1.0,
        id: 1,
    }];
    writer.ask(id, &[0.0], search, &found, points.read_revision().0);
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

/// Another writer's record that gives a stored point another tag.
fn foreign_tag(writer: &mut Writer, points: &mut LocalPoints, id: u64, tag: u64) {
    let row = points.get(id).expect("a point").row;
    let stored = NewRow {
        id,
        tag,
        row: &row,
        is_new: false,
    };
    writer
        .apply([stored].into_iter(), &[], points)
        .expect("a state");
}

/// The answers to the searches of a batch of session 1, which the feed has reached.
fn confirmed(writer: &mut Writer, points: &mut LocalPoints, number: u64) -> Vec<Meanwhile> {
    let named = writer.confirm(1, number, points).expect("a batch");
    let named = named.expect("an own batch").into_iter();
    named
        .flat_map(|it| it.answers(&space()).collect::<Vec<_>>())
        .collect()
}

fn neighbor_ids(answer: &Meanwhile) -> Vec<u64> {
    let neighbors = answer.neighbors.iter();
    neighbors.map(|neighbor| neighbor.id).collect()
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

/// The first batch is answered exactly, the second one after a reload by a superset.
#[test]
fn a_question_is_answered_when_its_point_is_published() {
    let (mut writer, mut points) = writer();
    let ask = |writer: &mut Writer, points: &mut LocalPoints, row: f64| {
        let id = insert(writer, points, row);
        let at = points.read_revision().0;
        writer.ask(id, &[row], &Search::nearest_k(1), &[], at);
        id
    };
    foreign(&mut writer, &mut points, 1, 0, 0.0);
    let first = ask(&mut writer, &mut points, 1.0);
    foreign(&mut writer, &mut points, 2, 0, 1.5);
    foreign(&mut writer, &mut points, 3, 0, 1.25);
    writer.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writer, &mut points, 1);
    assert_eq!(answers.len(), 1);
    assert_eq!((answers[0].id, answers[0].neighbors.len()), (first, 1));
    assert_eq!(answers[0].points_before, 3);
    assert_eq!(
        (answers[0].neighbors[0].id, answers[0].is_superset),
        (3, false)
    );

    let second = ask(&mut writer, &mut points, 2.0);
    writer.next(1, 0).expect("a batch");
    reload(
        &mut writer,
        &mut points,
        30,
        &[(1, 0, 0.0), (first, 0, 1.0), (4, 0, 2.5)],
    );
    let answers = writer.acknowledge(2, 40, 30, &mut points).expect("a batch");
    assert!(answers.is_empty());
    let answers = confirmed(&mut writer, &mut points, 2);
    assert_eq!((answers[0].id, answers[0].is_superset), (second, true));
    assert_eq!((answers[0].points_before, writer.bytes), (3, 0));
    assert_eq!(neighbor_ids(&answers[0]), [4, first, 1]);
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

/// Own and foreign changes between an insert and its place in the order.
#[test]
fn an_answer_counts_the_points_before_its_own() {
    let (mut writer, mut points) = writer();
    for id in [1, 2, 3] {
        foreign(&mut writer, &mut points, id, 0, 0.0);
    }
    writer
        .change(1, &Step::Remove, &mut points)
        .expect("a point");
    let ask = |writer: &mut Writer, points: &mut LocalPoints| {
        let id = insert(writer, points, 1.0);
        let at = points.read_revision().0;
        writer.ask(id, &[1.0], &Search::nearest_r(0.1), &[], at);
        id
    };
    let first = ask(&mut writer, &mut points);
    writer
        .change(2, &Step::Remove, &mut points)
        .expect("a point");
    insert(&mut writer, &mut points, 5.0);
    let second = ask(&mut writer, &mut points);
    // The first removal has no effect, and the second one has: point 4 comes, and points 1 and 3 go.
    foreign(&mut writer, &mut points, 4, 0, 9.0);
    writer
        .apply(std::iter::empty(), &[1, 3], &mut points)
        .expect("points");
    writer.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writer, &mut points, 1);
    let counts: Vec<_> = answers.iter().map(|it| (it.id, it.points_before)).collect();
    assert_eq!(counts, [(first, 2), (second, 3)]);
    assert!(answers[0].neighbors.is_empty());
    assert_eq!(writer.published_points, points.forest.len());
}

/// Answers without neighbours take memory too.
#[test]
fn answers_that_no_one_takes_are_dropped() {
    let (mut writer, _) = writer();
    let answer = |id| Meanwhile {
        id,
        points_before: 0,
        neighbors: Vec::new(),
        is_superset: false,
    };
    (0..1_000_000).for_each(|id| writer.open_searches.add(answer(id)));
    let taken = writer.open_searches.take();
    assert!(taken.has_dropped);
    assert!(taken.answers.len() * size_of::<Meanwhile>() <= 16 << 20);
    assert_eq!(taken.answers.last().map(|it| it.id), Some(999_999));
    assert!(!writer.open_searches.take().has_dropped);
}

#[test]
fn a_point_that_takes_the_place_of_a_removed_neighbor_is_answered() {
    let (mut writer, mut points) = writer();
    foreign(&mut writer, &mut points, 1, 0, 1.0);
    insert_near_1(&mut writer, &mut points, &Search::nearest_k(1));
    writer
        .apply(std::iter::empty(), &[1], &mut points)
        .expect("a point");
    foreign(&mut writer, &mut points, 2, 0, 2.0);
    writer.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writer, &mut points, 1);
    assert_eq!(neighbor_ids(&answers[0]), [2]);
}

/// A pending write of its own may hide the neighbor from the writer before it learns of the tag.
#[test]
fn a_point_that_takes_the_place_of_a_neighbor_with_another_tag_is_answered() {
    let mut search = Search::nearest_k(1);
    (search.filter.tag_mask, search.filter.tag_value) = (1, 1);
    for is_hidden in [false, true] {
        let (mut writer, mut points) = writer();
        foreign(&mut writer, &mut points, 1, 1, 1.0);
        insert_near_1(&mut writer, &mut points, &search);
        if is_hidden {
            let tag = Step::SetTag(0);
            writer.change(1, &tag, &mut points).expect("a point");
        }
        foreign_tag(&mut writer, &mut points, 1, 0);
        foreign(&mut writer, &mut points, 2, 1, 3.0);
        writer.next(1, 0).expect("a batch");
        let answers = confirmed(&mut writer, &mut points, 1);
        assert_eq!(neighbor_ids(&answers[0]), [2], "{is_hidden}");
    }
}

/// Two writers store the same id at once.
#[test]
fn a_point_is_no_neighbor_of_its_own() {
    let (mut writer, mut points) = writer();
    let own = put(0, &[0.0]);
    writer.change(5, &own, &mut points).expect("a state");
    let at = points.read_revision().0;
    writer.ask(5, &[0.0], &Search::nearest_k(1), &[], at);
    foreign(&mut writer, &mut points, 5, 0, 0.5);
    foreign(&mut writer, &mut points, 6, 0, 2.0);
    writer.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writer, &mut points, 1);
    assert_eq!(neighbor_ids(&answers[0]), [6]);
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
