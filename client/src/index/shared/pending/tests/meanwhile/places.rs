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
