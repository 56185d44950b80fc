//! The places of neighbours that leave, and of points that the search does not count.

use wayfold_index::{ScaledSearch, Scaling};

use super::*;

#[test]
fn a_point_that_takes_the_place_of_a_removed_neighbor_is_answered() {
    let (mut writes, mut points) = pending_writes();
    foreign(&mut writes, &mut points, 1, 0, 1.0);
    insert_near_1(&mut writes, &mut points, &Search::nearest_k(1));
    writes
        .apply(std::iter::empty(), &[1], &mut points)
        .expect("a point");
    foreign(&mut writes, &mut points, 2, 0, 2.0);
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 1);
    assert_eq!(neighbor_ids(&answers[0]), [2]);
}

/// A pending write of its own may hide the neighbor from this process before it learns of the tag.
#[test]
fn a_point_that_takes_the_place_of_a_neighbor_with_another_tag_is_answered() {
    let mut search = Search::nearest_k(1);
    (search.filter.tag_mask, search.filter.tag_value) = (1, 1);
    for is_hidden in [false, true] {
        let (mut writes, mut points) = pending_writes();
        foreign(&mut writes, &mut points, 1, 1, 1.0);
        insert_near_1(&mut writes, &mut points, &search);
        if is_hidden {
            let tag = Step::SetTag(0);
            writes.change(1, &tag, &mut points).expect("a point");
        }
        foreign_tag(&mut writes, &mut points, 1, 0);
        foreign(&mut writes, &mut points, 2, 1, 3.0);
        writes.next(1, 0).expect("a batch");
        let answers = confirmed(&mut writes, &mut points, 1);
        assert_eq!(neighbor_ids(&answers[0]), [2], "{is_hidden}");
    }
}

#[test]
fn a_point_that_takes_the_place_of_a_moved_neighbor_is_answered() {
    let (mut writes, mut points) = pending_writes();
    foreign(&mut writes, &mut points, 1, 0, 1.0);
    insert_near_1(&mut writes, &mut points, &Search::nearest_k(1));
    foreign(&mut writes, &mut points, 1, 0, 10.0);
    foreign(&mut writes, &mut points, 2, 0, 2.0);
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 1);
    assert_eq!(neighbor_ids(&answers[0]), [2]);
}

/// The nearest point whose tag is odd.
fn nearest_odd() -> Search<'static> {
    Search {
        k: 1,
        radius: f64::INFINITY,
        ..odd_tags()
    }
}

/// The insert found the point 1. The point 2 lies behind it.
#[test]
fn an_older_point_that_takes_the_place_of_a_neighbor_is_told() {
    let ways_to_leave: [fn(&mut PendingWrites, &mut LocalPoints); 3] = [
        |writes, points| {
            let removed = writes.apply(std::iter::empty(), &[1], points);
            removed.expect("a point");
        },
        |writes, points| foreign(writes, points, 1, 1, 10.0),
        |writes, points| foreign_tag(writes, points, 1, 0),
    ];
    for leave in ways_to_leave {
        let (mut writes, mut points) = pending_writes();
        foreign(&mut writes, &mut points, 1, 1, 1.0);
        foreign(&mut writes, &mut points, 2, 1, 2.0);
        ask(&mut writes, &mut points, &nearest_odd(), &[(1, 1.0)]);
        leave(&mut writes, &mut points);
        writes.next(1, 0).expect("a batch");
        let answers = confirmed(&mut writes, &mut points, 1);
        assert_eq!(told(&answers), [[2]]);
        assert!(answers[0].is_superset);
    }
}

/// The own points come after the search and are nearer than the older point 2.
#[test]
fn own_later_points_push_out_no_older_one() {
    let (mut writes, mut points) = pending_writes();
    foreign(&mut writes, &mut points, 1, 0, 1.0);
    foreign(&mut writes, &mut points, 2, 0, 2.0);
    ask(&mut writes, &mut points, &Search::nearest_k(1), &[(1, 1.0)]);
    let mut expected: Vec<u64> = (1..=10)
        .map(|step| insert(&mut writes, &mut points, f64::from(step) / 10.0))
        .collect();
    expected.push(2);
    let removed = writes.apply(std::iter::empty(), &[1], &mut points);
    removed.expect("a point");
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 1);
    assert_eq!(told(&answers), [expected]);
}

/// The copy is read again in between, without the neighbour.
#[test]
fn after_a_reload_an_older_point_that_takes_the_place_of_a_neighbor_is_told() {
    let (mut writes, mut points) = pending_writes();
    let rows = [(1, 1, 1.0), (2, 1, 2.0), (3, 1, 3.0)];
    for (id, tag, row) in rows {
        foreign(&mut writes, &mut points, id, tag, row);
    }
    ask(&mut writes, &mut points, &nearest_odd(), &[(1, 1.0)]);
    reload(&mut writes, &mut points, 30, &rows[1..]);
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 1);
    assert_eq!(told(&answers), [[2]]);
}

/// Another point leaves, and one arrives behind the neighbour.
#[test]
fn a_neighbor_that_stays_bounds_the_answer() {
    let (mut writes, mut points) = pending_writes();
    foreign(&mut writes, &mut points, 1, 1, 1.0);
    foreign(&mut writes, &mut points, 2, 1, 2.0);
    ask(&mut writes, &mut points, &nearest_odd(), &[(1, 1.0)]);
    foreign_tag(&mut writes, &mut points, 1, 3);
    foreign(&mut writes, &mut points, 2, 1, 5.0);
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 1);
    assert_eq!(told(&answers), [Vec::<u64>::new()]);
    assert!(!answers[0].is_superset);
}

/// By hand: r(4) = ln 4 / 4 = 0.347, and r(3) = ln 3 / 3 = 0.366.
#[test]
fn an_older_point_within_a_radius_that_grows_by_a_removal_is_told() {
    let (mut writes, mut points) = pending_writes();
    for (id, row) in [(1, 0.36), (2, 9.0), (3, 10.0), (4, 11.0)] {
        foreign(&mut writes, &mut points, id, 0, row);
    }
    let scaled = ScaledSearch {
        search: Search::nearest_k(usize::MAX),
        scaling: Scaling {
            radius_factor: Some(1.0),
            ..Scaling::default()
        },
    };
    let search = InsertSearch::new(&scaled, points.forest.len(), 1);
    let id = insert(&mut writes, &mut points, 0.0);
    let change = points.read_revision().0;
    writes.note_search(id, &[0.0], &search, &[], change);
    writes
        .apply(std::iter::empty(), &[4], &mut points)
        .expect("a point");
    writes.next(1, 0).expect("a batch");
    let answers = confirmed(&mut writes, &mut points, 1);
    assert_eq!(told(&answers), [[1]]);
    assert!(answers[0].is_superset);
}

/// The point 2 was stored before the revision and gets its tag after it. The points 3 and 4 are stored after it; 3 gets
/// its tag later.
#[test]
fn a_point_that_only_got_its_tag_since_takes_no_place_of_a_later_one() {
    for (k, expected) in [(1, vec![2, 3]), (2, vec![2, 3, 4])] {
        let (mut writes, mut points) = pending_writes();
        foreign(&mut writes, &mut points, 2, 0, 1.0);
        let mut search = Search { k, ..nearest_odd() };
        search.filter.since_revision = points.read_revision().0;
        ask(&mut writes, &mut points, &search, &[]);
        foreign_tag(&mut writes, &mut points, 2, 1);
        foreign(&mut writes, &mut points, 3, 0, 3.0);
        foreign_tag(&mut writes, &mut points, 3, 1);
        foreign(&mut writes, &mut points, 4, 1, 4.0);
        writes.next(1, 0).expect("a batch");
        let answers = confirmed(&mut writes, &mut points, 1);
        assert_eq!(told(&answers), [expected]);
        assert!(!answers[0].is_superset);
    }
}
