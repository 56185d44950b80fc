//! Compare-and-sets of one point: which take effect, and which are refused.

use std::collections::BTreeMap;

use wayfold_tests::history::{Call, Operation, Point, ReadPoints, Step, Violation, check};

use crate::{mutation, operation, put, rejected, stored_point, unknown};

/// The point.
const ID: u64 = 7;

fn set_if(tag: u64, if_revision: u64) -> Step {
    Step::SetTagIf {
        id: ID,
        tag,
        if_revision,
    }
}

fn conflict(client: u64, times: (u64, u64), if_revision: u64) -> Operation {
    let id = ID;
    operation(client, times, Call::Conflict { id, if_revision })
}

/// A read of the point, which was stored at revision 1, with its tag.
fn tagged(client: u64, times: (u64, u64), revision: u64, tag: u64) -> Operation {
    let point = Point {
        tag,
        ..stored_point(ID, 1)
    };
    let call = Call::Read {
        latest: true,
        revision,
        seen: ReadPoints::These(BTreeMap::from([(ID, point)])),
    };
    operation(client, times, call)
}

fn overwritten(revision: u64, changed: u64) -> Violation {
    Violation::Overwritten {
        revision,
        id: ID,
        changed,
    }
}

fn unprovoked(if_revision: u64) -> Violation {
    let id = ID;
    Violation::Unprovoked { id, if_revision }
}

#[test]
fn one_of_two_compare_and_sets_of_one_revision_takes_effect() {
    let first = mutation(1, (2, 5), 2, set_if(1, 1));
    let one = [
        put(0, (0, 1), 1, ID),
        first.clone(),
        conflict(2, (2, 6), 1),
        tagged(2, (7, 8), 2, 1),
    ];
    assert_eq!(check(&one).map(|it| it.conflicts), Ok(1));
    let both = [
        put(0, (0, 1), 1, ID),
        first,
        mutation(2, (2, 6), 3, set_if(2, 1)),
    ];
    assert_eq!(rejected(&both), [overwritten(3, 2)]);
}

#[test]
fn a_compare_and_set_after_any_change_of_its_point_is_rejected() {
    let history = |change, if_revision| {
        [
            put(0, (0, 1), 1, ID),
            mutation(0, (2, 3), 2, change),
            mutation(1, (4, 5), 3, set_if(9, if_revision)),
        ]
    };
    let changed = |if_revision| history(Step::SetTag(ID, 5), if_revision);
    assert!(check(&changed(2)).is_ok());
    assert_eq!(rejected(&changed(1)), [overwritten(3, 2)]);
    // The insert of the point changes it too, and the tag that it has already does not.
    let same = |if_revision| history(Step::SetTag(ID, 0), if_revision);
    assert!(check(&same(1)).is_ok());
    assert_eq!(rejected(&same(0)), [overwritten(3, 1)]);
}

#[test]
fn a_refusal_without_a_change_after_the_revision_is_rejected() {
    let stored = || put(0, (0, 1), 1, ID);
    let change = |times, revision| mutation(0, times, revision, Step::SetTag(ID, 5));
    assert_eq!(
        rejected(&[stored(), conflict(1, (2, 3), 1)]),
        [unprovoked(1)]
    );
    let before = [stored(), change((2, 3), 2), conflict(1, (4, 5), 2)];
    assert_eq!(rejected(&before), [unprovoked(2)]);
    let later = [stored(), conflict(1, (2, 3), 1), change((4, 5), 2)];
    assert_eq!(rejected(&later), [unprovoked(1)]);
    let meanwhile = [stored(), conflict(1, (2, 5), 1), change((4, 6), 2)];
    assert!(check(&meanwhile).is_ok());
    let of_another = [stored(), put(0, (2, 3), 2, ID + 1), conflict(1, (4, 5), 1)];
    assert_eq!(rejected(&of_another), [unprovoked(1)]);
}

#[test]
fn a_refusal_may_come_from_a_change_without_an_answer() {
    let history = |invoked| {
        [
            put(0, (0, 1), 1, ID),
            unknown(1, invoked, vec![Step::SetTag(ID, 5)]),
            conflict(2, (3, 4), 1),
        ]
    };
    assert!(check(&history(2)).is_ok());
    assert_eq!(rejected(&history(5)), [unprovoked(1)]);
}

#[test]
fn a_refused_compare_and_set_that_took_effect_is_rejected() {
    let history = |tag| {
        [
            put(0, (0, 1), 1, ID),
            mutation(0, (2, 3), 2, Step::SetTag(ID, 5)),
            conflict(1, (2, 5), 1),
            tagged(2, (6, 7), 3, tag),
        ]
    };
    assert!(check(&history(5)).is_ok());
    let id = ID;
    assert_eq!(rejected(&history(9)), [Violation::NoPrefix { read: 3, id }]);
}

#[test]
fn a_compare_and_set_without_an_answer_may_have_taken_effect() {
    let history = |tag, then| {
        [
            put(0, (0, 1), 1, ID),
            unknown(1, 2, vec![set_if(9, 1)]),
            tagged(2, (3, 4), 3, tag),
            then,
        ]
    };
    let found = |history: &[Operation]| check(history).map(|it| it.found);
    let another = |if_revision| mutation(3, (5, 6), 4, set_if(8, if_revision));
    // If it has, another one of the same revision is refused. Its own revision is 2 or 3.
    assert_eq!(found(&history(9, conflict(3, (5, 6), 1))), Ok(1));
    assert_eq!(rejected(&history(9, another(1))), [overwritten(4, 2)]);
    assert_eq!(found(&history(9, another(2))), Ok(1));
    // If it has not, the other one takes effect.
    assert_eq!(found(&history(0, another(1))), Ok(0));
    // It is seen, so it was not to be refused.
    let refused = [
        put(0, (0, 1), 1, ID),
        unknown(1, 2, vec![set_if(9, 0)]),
        tagged(2, (3, 4), 3, 9),
    ];
    assert_eq!(rejected(&refused), [overwritten(3, 1)]);
}
