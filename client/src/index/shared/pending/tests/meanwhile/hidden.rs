//! Points of others that own pending writes hide or change in the copy.

use super::*;

fn change(writes: &mut PendingWrites, points: &mut LocalPoints, id: u64, step: &Step<'_>) {
    writes.change(id, step, points).expect("a point");
}

/// The first search precedes the own tag. The second one has seen it.
#[test]
fn a_tag_that_another_writer_sets_before_an_own_one_is_told_to_the_searches_between() {
    let (mut writes, mut points) = pending_writes();
    foreign(&mut writes, &mut points, 2, 0, 0.5);
    ask(&mut writes, &mut points, &odd_tags(), &[]);
    change(&mut writes, &mut points, 2, &Step::SetTag(1));
    ask(&mut writes, &mut points, &odd_tags(), &[(2, 0.5)]);
    foreign_tag(&mut writes, &mut points, 2, 1);
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 1);
    assert_eq!(told(&answers), [vec![2], Vec::<u64>::new()]);
    assert!(answers.iter().all(|answer| !answer.is_superset));
}

/// The copy hides the point only after the search.
#[test]
fn a_point_that_a_search_saw_is_not_told_for_another_tag_of_the_search() {
    for step in [Step::SetTag(0), Step::Remove] {
        let (mut writes, mut points) = pending_writes();
        foreign(&mut writes, &mut points, 2, 1, 0.5);
        ask(&mut writes, &mut points, &odd_tags(), &[(2, 0.5)]);
        change(&mut writes, &mut points, 2, &step);
        let stored = NewRow {
            id: 2,
            tag: 3,
            row: &[0.5],
            is_new: false,
        };
        writes
            .apply([stored].into_iter(), &[], &mut points)
            .expect("a state");
        writes.next(1, 0).expect("a batch");
        let answers = confirmed(&mut writes, &mut points, 1);
        assert_eq!(told(&answers), [Vec::<u64>::new()], "{step:?}");
    }
}

/// The own state comes after that of the other writer. The first search precedes both.
#[test]
fn a_state_that_an_own_one_replaced_before_the_search_is_not_told() {
    let (mut writes, mut points) = pending_writes();
    let search = Search::nearest_r(1.0);
    foreign(&mut writes, &mut points, 2, 0, 5.0);
    ask(&mut writes, &mut points, &search, &[]);
    change(&mut writes, &mut points, 2, &Step::Replace { row: &[0.5] });
    ask(&mut writes, &mut points, &search, &[(2, 0.5)]);
    foreign(&mut writes, &mut points, 2, 0, 0.25);
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 1);
    assert_eq!(told(&answers), [vec![2], Vec::<u64>::new()]);
}

#[test]
fn after_a_reload_a_tag_that_own_and_other_writers_set_is_told() {
    let (mut writes, mut points) = pending_writes();
    foreign(&mut writes, &mut points, 2, 0, 0.5);
    ask(&mut writes, &mut points, &odd_tags(), &[]);
    change(&mut writes, &mut points, 2, &Step::SetTag(1));
    reload(&mut writes, &mut points, 30, &[(2, 1, 0.5)]);
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 1);
    assert_eq!(told(&answers), [[2]]);
    assert!(answers[0].is_superset);
}

/// The search found the point 1. An own write hides it, and the other writers do the same before.
#[test]
fn after_a_reload_a_neighbor_that_own_and_other_writers_removed_has_left() {
    let search = Search {
        k: 1,
        radius: f64::INFINITY,
        ..odd_tags()
    };
    let steps = [Step::SetTag(0), Step::Remove];
    for (step, rest) in steps.iter().zip([Some((1, 0, 1.0)), None]) {
        let (mut writes, mut points) = pending_writes();
        foreign(&mut writes, &mut points, 1, 1, 1.0);
        ask(&mut writes, &mut points, &search, &[(1, 1.0)]);
        change(&mut writes, &mut points, 1, step);
        let rows: Vec<_> = rest.into_iter().chain([(7, 1, 2.0)]).collect();
        reload(&mut writes, &mut points, 30, &rows);
        writes.next(1, 0).expect("a batch");
        let answers = confirmed(&mut writes, &mut points, 1);
        assert_eq!(told(&answers), [[7]], "{step:?}");
    }
}

/// The copy was read again with an own state and a later one of another writer, before the answer to the own write. A
/// later own state may hide the other one again.
#[test]
fn a_state_that_shows_once_an_own_write_is_confirmed_is_told() {
    let search = Search::nearest_r(1.0);
    let far = Step::Replace { row: &[9.0] };
    for is_hidden_again in [false, true] {
        let (mut writes, mut points) = pending_writes();
        foreign(&mut writes, &mut points, 5, 0, 5.0);
        change(&mut writes, &mut points, 5, &far);
        writes.next(1, 0).expect("a batch");
        reload(&mut writes, &mut points, 20, &[(5, 0, 0.5)]);
        ask(&mut writes, &mut points, &search, &[]);
        if is_hidden_again {
            change(&mut writes, &mut points, 5, &far);
        }
        writes.acknowledge(1, 15, 20, &mut points).expect("a batch");
        writes.next(1, 0).expect("a batch");
        let answers = confirmed(&mut writes, &mut points, 2);
        assert_eq!(told(&answers), [[5]], "{is_hidden_again}");
        assert!(!answers[0].is_superset);
    }
}

#[test]
fn a_tag_of_the_search_that_shows_in_place_of_another_one_is_not_told() {
    let (mut writes, mut points) = pending_writes();
    foreign(&mut writes, &mut points, 5, 0, 0.5);
    change(&mut writes, &mut points, 5, &Step::SetTag(1));
    writes.next(1, 0).expect("a batch");
    reload(&mut writes, &mut points, 20, &[(5, 3, 0.5)]);
    ask(&mut writes, &mut points, &odd_tags(), &[(5, 0.5)]);
    writes.acknowledge(1, 15, 20, &mut points).expect("a batch");
    assert_eq!(shown(&points, 5), Some((3, 0.5)));
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 2);
    assert_eq!(told(&answers), [Vec::<u64>::new()]);
}

/// The server acknowledged the removed point before the copy was read again, and the feed has not named it.
#[test]
fn after_a_reload_an_own_acknowledged_point_that_others_removed_has_left() {
    let (mut writes, mut points) = pending_writes();
    let near = insert(&mut writes, &mut points, 1.0);
    writes.next(1, 0).expect("a batch");
    let early = writes.acknowledge(1, 5, 4, &mut points).expect("a batch");
    assert!(early.is_empty());
    ask(
        &mut writes,
        &mut points,
        &Search::nearest_k(1),
        &[(near, 1.0)],
    );
    reload(&mut writes, &mut points, 30, &[(7, 0, 2.0)]);
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 2);
    assert_eq!(told(&answers), [[7]]);
}

/// The own ids come from two blocks. The neighbour, which got an own tag, has an id between them.
#[test]
fn after_a_reload_a_neighbor_with_an_id_between_own_ones_has_left() {
    let (mut writes, mut points) = (PendingWrites::new(1), LocalPoints::new(&space()));
    writes.open(1, block(100, 1));
    writes.reserve(block(200, 1));
    foreign(&mut writes, &mut points, 150, 0, 1.0);
    insert(&mut writes, &mut points, 50.0);
    change(&mut writes, &mut points, 150, &Step::SetTag(5));
    ask(
        &mut writes,
        &mut points,
        &Search::nearest_k(1),
        &[(150, 1.0)],
    );
    reload(&mut writes, &mut points, 30, &[(7, 0, 2.0)]);
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 1);
    assert_eq!(told(&answers), [[7]]);
}

/// The answer to the batch of the removed point comes after the copy was read again.
#[test]
fn an_own_point_that_others_removed_has_left_once_its_batch_is_confirmed() {
    let (mut writes, mut points) = pending_writes();
    let near = insert(&mut writes, &mut points, 1.0);
    writes.next(1, 0).expect("a batch");
    ask(
        &mut writes,
        &mut points,
        &Search::nearest_k(1),
        &[(near, 1.0)],
    );
    reload(&mut writes, &mut points, 30, &[(7, 0, 2.0)]);
    writes.acknowledge(1, 5, 30, &mut points).expect("a batch");
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 2);
    assert_eq!(told(&answers), [[7]]);
}

/// Their states precede the insert, and their tags perhaps not. If they took no part of a place, thousands of them would
/// push out other answers.
#[test]
fn after_a_reload_points_whose_tag_may_be_newer_take_parts_of_places() {
    for (k, rows, nearest) in [(1, 2..4, 2..4), (2, 2..1_000, 2..34)] {
        let (mut writes, mut points) = pending_writes();
        let search = Search {
            k,
            radius: f64::INFINITY,
            ..odd_tags()
        };
        ask(&mut writes, &mut points, &search, &[]);
        writes.next(1, 0).expect("a batch");
        let taken = writes.acknowledge(1, 8, 0, &mut points);
        assert!(taken.expect("a batch").is_empty());
        let rows: Vec<_> = rows.map(|id| (id, 1, id as f64)).collect();
        let answers = reload_at(&mut writes, &mut points, 30, &rows, 7);
        assert_eq!(told(&answers), [nearest.collect::<Vec<_>>()]);
    }
}

/// The own state replaces that of the other writer, and both tags are of the search, which has seen the point.
#[test]
fn a_point_is_not_told_again_for_a_state_that_an_own_one_replaced_and_another_tag() {
    let (mut writes, mut points) = pending_writes();
    foreign(&mut writes, &mut points, 2, 1, 5.0);
    change(&mut writes, &mut points, 2, &Step::Replace { row: &[0.5] });
    ask(&mut writes, &mut points, &odd_tags(), &[(2, 0.5)]);
    foreign(&mut writes, &mut points, 2, 3, 0.25);
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 1);
    assert_eq!(told(&answers), [Vec::<u64>::new()]);
}
