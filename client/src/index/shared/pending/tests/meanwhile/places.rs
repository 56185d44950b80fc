//! The places of neighbours that leave, and of points that the search does not count.

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
