//! The checker of the calls for indices that are created and deleted under one name.

use wayfold_tests::history::{
    NEVER, Operation, Step, Violation,
    names::{NameCall, NameOperation, NameViolation, NamesChecked, check},
};

use crate::{put, read, unknown};

fn call(server: u64, times: (u64, u64), call: NameCall) -> NameOperation {
    let (invoked, returned) = times;
    NameOperation {
        server,
        client: server,
        invoked,
        returned,
        call,
    }
}

fn create(server: u64, times: (u64, u64), uid: &str) -> NameOperation {
    let (uid, created) = (uid.into(), true);
    call(server, times, NameCall::Create { uid, created })
}

fn find(server: u64, times: (u64, u64), uid: &str) -> NameOperation {
    let (uid, created) = (uid.into(), false);
    call(server, times, NameCall::Create { uid, created })
}

fn delete(server: u64, times: (u64, u64), uid: &str) -> NameOperation {
    call(server, times, NameCall::Delete(uid.into()))
}

fn gone(server: u64, times: (u64, u64), uid: &str) -> NameOperation {
    call(server, times, NameCall::Gone(uid.into()))
}

fn settled(time: u64, uid: Option<&str>) -> NameOperation {
    let settled = NameCall::Settled(uid.map(Into::into));
    call(0, (time, time + 1), settled)
}

/// An operation on the points of an index, at the server with the number of its client.
fn points(uid: &str, operation: Operation) -> NameOperation {
    NameOperation {
        server: operation.client,
        client: operation.client,
        invoked: operation.invoked,
        returned: operation.returned,
        call: NameCall::Points(uid.into(), operation.call),
    }
}

fn rejected(calls: &[NameOperation]) -> Vec<NameViolation> {
    check(calls).expect_err("a contradiction")
}

#[test]
fn one_index_after_another_is_accepted() {
    let calls = [
        create(0, (0, 1), "a"),
        find(1, (2, 3), "a"),
        points("a", put(0, (4, 5), 1, 7)),
        points("a", read(1, (6, 7), true, 2, &[(7, 1)])),
        delete(0, (8, 11), "a"),
        // The other server has not heard of it yet, and then it has.
        find(1, (12, 13), "a"),
        gone(1, (14, 15), "a"),
        create(1, (9, 16), "b"),
        points("b", put(1, (17, 18), 1, 8)),
        settled(20, Some("b")),
        points("b", read(2, (20, 21), true, 2, &[(8, 1)])),
    ];
    let checked = NamesChecked {
        indexes: 2,
        deleted: 1,
        acknowledged: 2,
        reads: 2,
    };
    assert_eq!(check(&calls), Ok(checked));
}

#[test]
fn two_indices_at_a_time_are_rejected() {
    let both = NameViolation::Both("a".into(), "b".into());
    let two = [create(0, (0, 1), "a"), create(1, (2, 3), "b")];
    assert_eq!(rejected(&two), std::slice::from_ref(&both));
    // A third one does not hide that the first is there still.
    let late = [
        create(0, (0, 1), "a"),
        create(1, (2, 3), "b"),
        delete(1, (4, 5), "b"),
        create(1, (6, 7), "c"),
    ];
    let third = NameViolation::Both("a".into(), "c".into());
    assert_eq!(rejected(&late), [both.clone(), third]);
    // It was deleted only after the answer that found the other one.
    let overlap = [
        create(0, (0, 1), "a"),
        create(1, (2, 5), "b"),
        delete(0, (6, 7), "a"),
    ];
    assert_eq!(rejected(&overlap), [both]);
    let deleted = |times| {
        [
            create(0, (0, 1), "a"),
            create(1, (2, 5), "b"),
            delete(0, times, "a"),
        ]
    };
    assert!(check(&deleted((4, 6))).is_ok());
    assert!(check(&deleted((4, NEVER))).is_ok());
}

#[test]
fn an_index_that_two_calls_created_is_rejected() {
    let twice = [create(0, (0, 1), "a"), create(1, (0, 1), "a")];
    let violation = NameViolation::CreatedTwice("a".into());
    assert_eq!(rejected(&twice), [violation]);
}

#[test]
fn an_index_that_nobody_deleted_is_not_gone() {
    let vanished = [NameViolation::Vanished("a".into())];
    let lost = [create(0, (0, 1), "a"), gone(1, (2, 3), "a")];
    assert_eq!(rejected(&lost), vanished);
    let later = [
        create(0, (0, 1), "a"),
        gone(1, (2, 3), "a"),
        delete(0, (4, 5), "a"),
    ];
    assert_eq!(rejected(&later), vanished);
    let at_the_end = [create(0, (0, 1), "a"), settled(2, None)];
    assert_eq!(rejected(&at_the_end), vanished);
    let unknown = [
        create(0, (0, 1), "a"),
        delete(0, (2, NEVER), "a"),
        gone(1, (3, 4), "a"),
        settled(5, None),
    ];
    assert!(check(&unknown).is_ok());
}

#[test]
fn a_deleted_index_that_comes_back_is_rejected() {
    let back = [NameViolation::Returned("a".into())];
    let deleted = |then| [create(0, (0, 1), "a"), delete(0, (2, 3), "a"), then];
    assert_eq!(rejected(&deleted(find(0, (4, 5), "a"))), back);
    assert!(check(&deleted(find(1, (4, 5), "a"))).is_ok());
    let read = points("a", read(0, (4, 5), false, 0, &[]));
    assert_eq!(rejected(&deleted(read)), back);
    assert_eq!(rejected(&deleted(settled(4, Some("a")))), back);
    let told = [
        create(0, (0, 1), "a"),
        delete(0, (2, NEVER), "a"),
        gone(1, (3, 4), "a"),
        find(1, (5, 6), "a"),
    ];
    assert_eq!(rejected(&told), back);
    // Without an answer it may have had no effect.
    let unknown = [
        create(0, (0, 1), "a"),
        delete(0, (2, NEVER), "a"),
        settled(4, Some("a")),
    ];
    assert!(check(&unknown).is_ok());
}

#[test]
fn a_lost_point_of_an_index_is_rejected_until_a_call_deletes_it() {
    let stored = || points("b", put(1, (2, 3), 1, 7));
    let empty = |times| points("b", read(0, times, true, 1, &[]));
    let lost = Violation::Lost {
        read: 1,
        id: 7,
        revision: 1,
    };
    let violation = NameViolation::Points("b".into(), vec![lost]);
    let calls = [create(0, (0, 1), "b"), stored(), empty((4, 5))];
    assert_eq!(rejected(&calls), [violation]);
    let deleted = |times| {
        [
            create(0, (0, 1), "b"),
            stored(),
            delete(1, (6, 7), "b"),
            empty(times),
        ]
    };
    assert_eq!(rejected(&deleted((4, 5))).len(), 1);
    assert!(check(&deleted((4, 7))).is_ok());
    // A point of the one has no place in the other.
    let other = [
        create(0, (0, 1), "a"),
        points("a", put(0, (2, 3), 1, 7)),
        delete(0, (4, 5), "a"),
        create(0, (6, 7), "b"),
        points("b", read(0, (8, 9), true, 1, &[(7, 1)])),
    ];
    let strange = Violation::NoPrefix { read: 1, id: 7 };
    let violation = NameViolation::Points("b".into(), vec![strange]);
    assert_eq!(rejected(&other), [violation]);
}

#[test]
fn a_mutation_that_overlaps_the_deletion_may_have_taken_effect() {
    let step = Step::Put {
        id: None,
        tag: 0,
        payload: 7,
    };
    let late = [
        points("a", put(0, (2, 9), 1, 7)),
        points("a", unknown(0, 2, vec![step])),
    ];
    for mutation in late {
        for seen in [&[(7, 1)][..], &[]] {
            let calls = [
                create(0, (0, 1), "a"),
                mutation.clone(),
                points("a", read(1, (3, 4), true, 2, seen)),
                delete(1, (5, 6), "a"),
            ];
            assert!(check(&calls).is_ok(), "{calls:?}");
        }
    }
}
