//! The records of a follower against the mutations of their revisions.

use std::collections::BTreeMap;

use wayfold_tests::history::{Call, Operation, Point, Step, Violation, check};

use crate::{mutation, operation, put, read, rejected, stored_point, unknown};

/// The client that follows.
const FOLLOWER: u64 = 9;

/// The record of a revision, at this time, with points by their ids and the revisions that stored them.
fn record(time: u64, revision: u64, stored: &[(u64, u64)], removed: &[u64]) -> Operation {
    let stored = stored.iter();
    let stored = stored.map(|&(id, stored)| (id, stored_point(id, stored)));
    let call = Call::Record {
        revision,
        stored: stored.collect(),
        removed: removed.iter().copied().collect(),
    };
    operation(FOLLOWER, (time, time + 1), call)
}

/// Two points are stored, and the first is removed.
fn mutations() -> Vec<Operation> {
    vec![
        put(0, (0, 1), 1, 7),
        put(0, (2, 3), 2, 8),
        mutation(0, (4, 5), 3, Step::Remove(7)),
    ]
}

/// These mutations, and then the records of these revisions.
fn followed(revisions: &[u64]) -> Vec<Operation> {
    let mut history = mutations();
    for (at, revision) in revisions.iter().enumerate() {
        let time = 10 + 2 * at as u64;
        history.push(match revision {
            1 => record(time, 1, &[(7, 1)], &[]),
            2 => record(time, 2, &[(8, 2)], &[]),
            _ => record(time, *revision, &[], &[7]),
        });
    }
    history
}

#[test]
fn a_follower_gets_each_record_once_and_in_order() {
    let checked = check(&followed(&[1, 2, 3]));
    assert_eq!(checked.map(|it| it.records), Ok(3));
    let client = FOLLOWER;
    for (revisions, after, revision) in [
        (&[1, 3][..], 1, 3),
        (&[1, 1, 2][..], 1, 1),
        (&[2, 3][..], 0, 2),
    ] {
        let violation = Violation::NotNext {
            client,
            after,
            revision,
        };
        assert_eq!(rejected(&followed(revisions)), [violation]);
    }
    assert!(check(&followed(&[1, 2, 1])).is_err());
}

#[test]
fn a_follower_may_begin_again_with_a_read_of_all_points() {
    let again = |revision, points: &[(u64, u64)], next| {
        let mut history = mutations();
        history.push(record(10, 1, &[(7, 1)], &[]));
        history.push(read(FOLLOWER, (12, 13), false, revision, points));
        history.push(next);
        history
    };
    let removal = || record(14, 3, &[], &[7]);
    assert!(check(&again(2, &[(7, 1), (8, 2)], removal())).is_ok());
    rejected(&again(3, &[(8, 2)], removal()));
    // Another server may be older, but not for this client.
    rejected(&again(0, &[], record(14, 1, &[(7, 1)], &[])));
}

#[test]
fn a_record_with_other_effects_than_its_mutation_is_rejected() {
    let first = || record(10, 1, &[(7, 1)], &[]);
    let divergent = |revision| [Violation::Divergent { revision }];
    let second = |record| [put(0, (0, 1), 1, 7), first(), record];
    assert!(check(&second(record(12, 2, &[], &[]))).is_ok());
    // No mutation has this revision.
    assert_eq!(
        rejected(&second(record(12, 2, &[(7, 1)], &[]))),
        divergent(2)
    );
    assert_eq!(rejected(&second(record(12, 2, &[], &[7]))), divergent(2));
    let unheard = rejected(&second(record(12, 2, &[(8, 2)], &[])));
    assert_eq!(unheard, [Violation::NoPrefix { read: 2, id: 8 }]);

    let lacks_point = [put(0, (0, 1), 1, 7), record(10, 1, &[], &[])];
    assert_eq!(rejected(&lacks_point), divergent(1));
    let removed = |record| {
        let removal = mutation(0, (2, 3), 2, Step::Remove(7));
        [put(0, (0, 1), 1, 7), removal, first(), record]
    };
    assert!(check(&removed(record(12, 2, &[], &[7]))).is_ok());
    assert_eq!(rejected(&removed(record(12, 2, &[], &[]))), divergent(2));
}

#[test]
fn a_record_tells_all_of_a_mutation_without_an_answer() {
    let history = |removed: &[u64]| {
        [
            put(0, (0, 1), 1, 7),
            put(0, (2, 3), 2, 8),
            unknown(1, 4, vec![Step::Remove(7), Step::Remove(8)]),
            record(10, 1, &[(7, 1)], &[]),
            record(12, 2, &[(8, 2)], &[]),
            record(14, 3, &[], removed),
        ]
    };
    assert_eq!(check(&history(&[7, 8])).map(|it| it.found), Ok(1));
    assert_eq!(check(&history(&[])).map(|it| it.found), Ok(0));
    let revision = 3;
    assert_eq!(
        rejected(&history(&[7])),
        [Violation::Divergent { revision }]
    );
}

#[test]
fn a_record_tells_the_revision_of_a_mutation_without_an_answer() {
    let history = |if_revision| {
        let point = Point {
            tag: 5,
            ..stored_point(7, 1)
        };
        let tagged = Call::Record {
            revision: 3,
            stored: BTreeMap::from([(7, point)]),
            removed: Default::default(),
        };
        let set_if = Step::SetTagIf {
            id: 7,
            tag: 6,
            if_revision,
        };
        [
            put(0, (0, 1), 1, 7),
            unknown(1, 2, vec![Step::SetTag(7, 5)]),
            record(10, 1, &[(7, 1)], &[]),
            record(12, 2, &[], &[]),
            operation(FOLLOWER, (14, 15), tagged),
            mutation(2, (16, 17), 4, set_if),
        ]
    };
    assert_eq!(check(&history(3)).map(|it| it.found), Ok(1));
    let violation = Violation::Overwritten {
        revision: 4,
        id: 7,
        changed: 3,
    };
    assert_eq!(rejected(&history(2)), [violation]);
}
