//! The answers to searches, without a server.

mod hidden;
mod places;

use super::*;

/// Inserts a point at 0, whose search found the point 1 at distance 1.
fn insert_near_1(writes: &mut PendingWrites, points: &mut LocalPoints, search: &Search<'_>) {
    ask(writes, points, search, &[(1, 1.0)]);
}

/// Another writer's record that gives a stored point another tag.
fn foreign_tag(writes: &mut PendingWrites, points: &mut LocalPoints, id: u64, tag: u64) {
    let row = points.get(id).expect("a point").row;
    let stored = NewRow {
        id,
        tag,
        row: &row,
        is_new: false,
    };
    writes
        .apply([stored].into_iter(), &[], points)
        .expect("a state");
}

/// The answers to the searches of a batch of session 1, which the feed has reached.
fn confirmed(writes: &mut PendingWrites, points: &mut LocalPoints, number: u64) -> Vec<Meanwhile> {
    let named = writes.confirm(1, number, points).expect("a batch");
    let named = named.expect("an own batch").into_iter();
    named
        .flat_map(|it| it.answers(&space()).collect::<Vec<_>>())
        .collect()
}

fn neighbor_ids(answer: &Meanwhile) -> Vec<u64> {
    let neighbors = answer.neighbors.iter();
    neighbors.map(|neighbor| neighbor.id).collect()
}

/// Inserts a point at 0, whose search found these points.
fn ask(
    writes: &mut PendingWrites,
    points: &mut LocalPoints,
    search: &Search<'_>,
    found: &[(u64, f64)],
) {
    let id = insert(writes, points, 0.0);
    let found = found.iter();
    let found: Vec<_> = found
        .map(|&(id, distance)| Neighbor { distance, id })
        .collect();
    let change = points.read_revision().0;
    writes.note_search(id, &[0.0], &(*search).into(), &found, change);
}

fn told(answers: &[Meanwhile]) -> Vec<Vec<u64>> {
    answers.iter().map(neighbor_ids).collect()
}

/// The points within 1.0 whose tag is odd.
fn odd_tags() -> Search<'static> {
    let mut search = Search::nearest_r(1.0);
    (search.filter.tag_mask, search.filter.tag_value) = (1, 1);
    search
}

/// The first batch is answered exactly, the second one after a reload by a superset.
#[test]
fn a_question_is_answered_when_its_point_is_published() {
    let (mut writes, mut points) = pending_writes();
    let ask = |writes: &mut PendingWrites, points: &mut LocalPoints, row: f64| {
        let id = insert(writes, points, row);
        let change = points.read_revision().0;
        writes.note_search(id, &[row], &Search::nearest_k(1).into(), &[], change);
        id
    };
    foreign(&mut writes, &mut points, 1, 0, 0.0);
    let first = ask(&mut writes, &mut points, 1.0);
    foreign(&mut writes, &mut points, 2, 0, 1.5);
    foreign(&mut writes, &mut points, 3, 0, 1.25);
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 1);
    assert_eq!(answers.len(), 1);
    assert_eq!((answers[0].id, answers[0].neighbors.len()), (first, 1));
    assert_eq!(answers[0].points_before, 3);
    assert_eq!(
        (answers[0].neighbors[0].id, answers[0].is_superset),
        (3, false)
    );

    let second = ask(&mut writes, &mut points, 2.0);
    writes.next(1, 0).expect("a batch");
    reload(
        &mut writes,
        &mut points,
        30,
        &[(1, 0, 0.0), (first, 0, 1.0), (4, 0, 2.5)],
    );
    let answers = writes.acknowledge(2, 40, 30, &mut points).expect("a batch");
    assert!(answers.is_empty());
    let answers = confirmed(&mut writes, &mut points, 2);
    assert_eq!((answers[0].id, answers[0].is_superset), (second, true));
    assert_eq!((answers[0].points_before, writes.bytes), (3, 0));
    assert_eq!(neighbor_ids(&answers[0]), [4]);
}

/// The search asks only for points that an earlier one could not see, and finds fewer than it asks for.
#[test]
fn after_a_reload_the_points_that_were_there_before_are_not_told() {
    let (mut writes, mut points) = pending_writes();
    foreign(&mut writes, &mut points, 1, 0, 0.0);
    foreign(&mut writes, &mut points, 2, 0, 0.1);
    let mut search = Search::nearest_k(2);
    search.filter.since_revision = points.read_revision().0;
    let ask = |writes: &mut PendingWrites, points: &mut LocalPoints| {
        let id = insert(writes, points, 0.5);
        let change = points.read_revision().0;
        writes.note_search(id, &[0.5], &search.into(), &[], change);
        writes.next(1, 0).expect("a batch");
        id
    };
    let first = ask(&mut writes, &mut points);
    // The server stores it, then the points 3 and 4, and moves the point 2.
    let early = writes.acknowledge(1, 20, 0, &mut points);
    assert!(early.expect("a batch").is_empty());
    let second = ask(&mut writes, &mut points);
    let rows = [
        (1, 0, 0.0),
        (2, 0, 9.0),
        (3, 0, 0.6),
        (4, 0, 0.8),
        (first, 0, 0.5),
    ];
    let answers = reload(&mut writes, &mut points, 30, &rows);
    assert_eq!(answers.len(), 1);
    assert_eq!((answers[0].id, answers[0].is_superset), (first, true));
    assert!(answers[0].neighbors.is_empty(), "they came later");
    let answers = confirmed(&mut writes, &mut points, 2);
    assert_eq!((answers[0].id, answers[0].is_superset), (second, true));
    assert_eq!(neighbor_ids(&answers[0]), [3, 4]);
}

/// The answer to the batch was lost. The copy that was read again has its point, and point 7; the feed brings point 8 later.
#[test]
fn after_a_reload_a_later_point_takes_no_place() {
    let (mut writes, mut points) = pending_writes();
    insert_near_1(&mut writes, &mut points, &Search::nearest_k(1));
    writes.next(1, 0).expect("a batch");
    let early = reload(&mut writes, &mut points, 18, &[(7, 0, 0.5), (100, 0, 0.0)]);
    assert!(early.is_empty());
    foreign(&mut writes, &mut points, 8, 0, 0.1);
    let answerable = writes.acknowledge(1, 20, 30, &mut points).expect("a batch");
    let answer = answerable[0].answers(&space()).next().expect("an answer");
    assert_eq!(neighbor_ids(&answer), [7]);
}

#[test]
fn after_a_reload_an_own_insert_that_is_not_in_it_has_not_left() {
    let (mut writes, mut points) = pending_writes();
    foreign(&mut writes, &mut points, 1, 0, 1.0);
    insert_near_1(&mut writes, &mut points, &Search::nearest_k(1));
    writes.next(1, 0).expect("a batch");
    let rows = [(1, 0, 1.0), (7, 0, 50.0)];
    assert!(reload(&mut writes, &mut points, 30, &rows).is_empty());
    let answers = confirmed(&mut writes, &mut points, 1);
    // It is farther than the neighbour that the insert found.
    assert!(answers[0].neighbors.is_empty());
}

#[test]
fn after_a_reload_a_point_that_came_before_is_told() {
    let (mut writes, mut points) = pending_writes();
    insert_near_1(&mut writes, &mut points, &Search::nearest_k(1));
    writes.next(1, 0).expect("a batch");
    let early = writes.acknowledge(1, 20, 0, &mut points).expect("a batch");
    assert!(early.is_empty());
    let answers = reload(&mut writes, &mut points, 20, &[(7, 0, 0.5), (100, 0, 0.0)]);
    assert_eq!(neighbor_ids(&answers[0]), [7]);
}

/// Own and foreign changes between an insert and its place in the order.
#[test]
fn an_answer_counts_the_points_before_its_own() {
    let (mut writes, mut points) = pending_writes();
    for id in [1, 2, 3] {
        foreign(&mut writes, &mut points, id, 0, 0.0);
    }
    writes
        .change(1, &Step::Remove, &mut points)
        .expect("a point");
    let ask = |writes: &mut PendingWrites, points: &mut LocalPoints| {
        let id = insert(writes, points, 1.0);
        let change = points.read_revision().0;
        writes.note_search(id, &[1.0], &Search::nearest_r(0.1).into(), &[], change);
        id
    };
    let first = ask(&mut writes, &mut points);
    writes
        .change(2, &Step::Remove, &mut points)
        .expect("a point");
    insert(&mut writes, &mut points, 5.0);
    let second = ask(&mut writes, &mut points);
    // The first removal has no effect, and the second one has: point 4 comes, and points 1 and 3 go.
    foreign(&mut writes, &mut points, 4, 0, 9.0);
    writes
        .apply(std::iter::empty(), &[1, 3], &mut points)
        .expect("points");
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 1);
    let counts: Vec<_> = answers.iter().map(|it| (it.id, it.points_before)).collect();
    assert_eq!(counts, [(first, 2), (second, 3)]);
    assert!(answers[0].neighbors.is_empty());
    assert_eq!(writes.published_points, points.forest.len());
}

/// Answers without neighbours take memory too.
#[test]
fn answers_that_no_one_takes_are_dropped() {
    let (mut writes, _) = pending_writes();
    let answer = |id| Meanwhile {
        id,
        points_before: 0,
        neighbors: Vec::new(),
        is_superset: false,
    };
    (0..1_000_000).for_each(|id| writes.open_searches.add(answer(id)));
    let taken = writes.open_searches.take();
    assert!(taken.has_dropped);
    assert!(taken.answers.len() * size_of::<Meanwhile>() <= 16 << 20);
    assert_eq!(taken.answers.last().map(|it| it.id), Some(999_999));
    assert!(!writes.open_searches.take().has_dropped);
}

/// Two writers store the same id at once.
#[test]
fn a_point_is_no_neighbor_of_its_own() {
    let (mut writes, mut points) = pending_writes();
    let own = put(0, &[0.0]);
    writes.change(5, &own, &mut points).expect("a state");
    let change = points.read_revision().0;
    writes.note_search(5, &[0.0], &Search::nearest_k(1).into(), &[], change);
    foreign(&mut writes, &mut points, 5, 0, 0.5);
    foreign(&mut writes, &mut points, 6, 0, 2.0);
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 1);
    assert_eq!(neighbor_ids(&answers[0]), [6]);
}

/// The writer gives points that arrived other tags after its own insert, in the same batch or in the next one.
#[test]
fn a_later_write_of_its_own_hides_no_neighbor() {
    let mut search = Search::nearest_r(1.0);
    (search.filter.tag_mask, search.filter.tag_value) = (1, 1);
    for is_sent in [true, false] {
        let (mut writes, mut points) = pending_writes();
        let id = insert(&mut writes, &mut points, 0.0);
        writes.note_search(id, &[0.0], &search.into(), &[], points.read_revision().0);
        if is_sent {
            writes.next(1, 0).expect("a batch");
        }
        foreign(&mut writes, &mut points, 2, 1, 0.5);
        foreign(&mut writes, &mut points, 3, 0, 0.5);
        for (id, tag) in [(2, 0), (3, 1)] {
            let step = Step::SetTag(tag);
            writes.change(id, &step, &mut points).expect("a tag");
        }
        writes.next(1, 0).expect("a batch");
        let answers = confirmed(&mut writes, &mut points, 1);
        assert_eq!(neighbor_ids(&answers[0]), [2], "{is_sent}");
    }
}

/// Two searches in a batch, with a write between them on a point that another writer moves later.
#[test]
fn a_search_finds_what_is_published_at_its_place_in_the_batch() {
    let mut search = Search::nearest_r(1.0);
    (search.filter.tag_mask, search.filter.tag_value) = (1, 1);
    let (mut writes, mut points) = pending_writes();
    foreign(&mut writes, &mut points, 2, 0, 5.0);
    for is_first in [true, false] {
        let id = insert(&mut writes, &mut points, 0.0);
        writes.note_search(id, &[0.0], &search.into(), &[], points.read_revision().0);
        if is_first {
            let step = Step::SetTag(1);
            writes.change(2, &step, &mut points).expect("a tag");
        }
    }
    foreign(&mut writes, &mut points, 2, 0, 0.5);
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 1);
    let [first, second] = &answers[..] else {
        panic!("{answers:?}");
    };
    assert!(first.neighbors.is_empty(), "{first:?}");
    assert_eq!(neighbor_ids(second), [2]);
}

/// Each search would look at each of the points.
#[test]
fn very_many_points_of_others_make_a_superset() {
    const SEARCHES: usize = 1000;
    let (mut writes, mut points) = pending_writes();
    writes.reserve(block(1000, SEARCHES as u64));
    let search = Search::nearest_r(0.5);
    for _ in 0..SEARCHES {
        let id = insert(&mut writes, &mut points, 0.0);
        writes.note_search(id, &[0.0], &search.into(), &[], points.read_revision().0);
    }
    writes.next(1, 0).expect("a batch");
    let rows: Vec<(u64, [f64; 1])> = (10_000..80_000).map(|id| (id, [id as f64])).collect();
    let stored = rows.iter().map(|(id, row)| NewRow {
        id: *id,
        tag: 0,
        row,
        is_new: true,
    });
    writes.apply(stored, &[], &mut points).expect("states");
    foreign(&mut writes, &mut points, 1, 0, 0.25);
    let answerable = writes.confirm(1, 1, &mut points).expect("states");
    let answerable = &answerable.expect("an own batch")[0];
    let first = answerable.answers(&space()).next().expect("an answer");
    assert!(first.is_superset);
    assert!(neighbor_ids(&first).contains(&1));
}

#[test]
fn searches_of_refused_writes_are_closed() {
    let (mut writes, mut points) = pending_writes();
    insert_near_1(&mut writes, &mut points, &Search::nearest_k(1));
    writes
        .refuse(Arc::new(crate::Error::Closed), &mut points)
        .expect("ids");
    assert_eq!(writes.open_searches.take().open, 0);
}

#[test]
fn answers_that_are_taken_leave_their_room() {
    let (mut writes, _) = pending_writes();
    for _ in 0..2 {
        for id in 0..200_000 {
            let neighbors = Vec::new();
            writes.open_searches.add(Meanwhile {
                id,
                points_before: 0,
                neighbors,
                is_superset: false,
            });
        }
        assert!(!writes.open_searches.take().has_dropped);
    }
}

#[test]
fn a_point_that_gets_a_tag_of_the_search_is_answered() {
    let mut search = Search::nearest_k(2);
    (search.filter.tag_mask, search.filter.tag_value) = (1, 1);
    let (mut writes, mut points) = pending_writes();
    foreign(&mut writes, &mut points, 1, 1, 1.0);
    foreign(&mut writes, &mut points, 2, 0, 3.0);
    insert_near_1(&mut writes, &mut points, &search);
    foreign_tag(&mut writes, &mut points, 2, 1);
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 1);
    assert_eq!(neighbor_ids(&answers[0]), [2]);
}
