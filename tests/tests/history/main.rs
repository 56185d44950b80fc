//! The checker of histories: it accepts what a store with one order answers, and rejects each contradiction.

mod compare_and_set;
mod followers;
mod names;
mod store;

use std::collections::BTreeMap;

use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use wayfold_tests::history::{
    Answer, Call, Checked, NEVER, Operation, Point, ReadPoints, Step, Violation, check,
};

use store::{Fault, Request, Store};

fn operation(client: u64, times: (u64, u64), call: Call) -> Operation {
    let (invoked, returned) = times;
    Operation {
        client,
        invoked,
        returned,
        call,
    }
}

/// Stores a point with its id as its payload.
fn put(client: u64, times: (u64, u64), revision: u64, id: u64) -> Operation {
    let step = Step::Put {
        id: Some(id),
        tag: 0,
        payload: id,
    };
    mutation(client, times, revision, step)
}

fn mutation(client: u64, times: (u64, u64), revision: u64, step: Step) -> Operation {
    answered(client, times, revision, step, true)
}

/// A mutation that found nothing to change.
fn unchanged(client: u64, times: (u64, u64), revision: u64, step: Step) -> Operation {
    answered(client, times, revision, step, false)
}

fn answered(client: u64, times: (u64, u64), revision: u64, step: Step, changed: bool) -> Operation {
    let answer = Answer { revision, changed };
    let call = Call::Mutation {
        steps: vec![step],
        answer: Some(answer),
    };
    operation(client, times, call)
}

fn unknown(client: u64, invoked: u64, steps: Vec<Step>) -> Operation {
    let call = Call::Mutation {
        steps,
        answer: None,
    };
    operation(client, (invoked, NEVER), call)
}

/// A read of points by their ids and the revisions that stored them.
fn read(
    client: u64,
    times: (u64, u64),
    latest: bool,
    revision: u64,
    points: &[(u64, u64)],
) -> Operation {
    let point = |&(id, stored)| (id, stored_point(id, stored));
    let seen = ReadPoints::All(points.iter().map(point).collect());
    let call = Call::Read {
        latest,
        revision,
        seen,
    };
    operation(client, times, call)
}

fn stored_point(payload: u64, stored: u64) -> Point {
    Point {
        tag: 0,
        payload,
        state: 0,
        stored,
    }
}

fn rejected(history: &[Operation]) -> Vec<Violation> {
    check(history).expect_err("a contradiction")
}

#[test]
fn operations_at_the_same_time_may_have_either_order() {
    let history = [
        put(0, (0, 10), 2, 7),
        put(1, (5, 9), 1, 8),
        read(2, (1, 8), true, 1, &[(8, 1)]),
        read(3, (11, 12), true, 3, &[(7, 2), (8, 1)]),
        read(4, (11, 12), false, 0, &[]),
    ];
    let checked = Checked {
        acknowledged: 2,
        latest: 2,
        plain: 1,
        ..Checked::default()
    };
    assert_eq!(check(&history), Ok(checked));
}

#[test]
fn a_lost_acknowledged_write_is_rejected() {
    let lost = [put(0, (0, 1), 1, 7), read(0, (2, 3), true, 1, &[])];
    let violation = Violation::Lost {
        read: 1,
        id: 7,
        revision: 1,
    };
    assert_eq!(rejected(&lost), [violation]);
    let removed = [
        put(0, (0, 1), 1, 7),
        mutation(0, (2, 3), 2, Step::Remove(7)),
        read(0, (4, 5), true, 2, &[(7, 1)]),
    ];
    let violation = Violation::Lost {
        read: 2,
        id: 7,
        revision: 2,
    };
    assert_eq!(rejected(&removed), [violation]);
    let tag = [
        put(0, (0, 1), 1, 7),
        mutation(0, (2, 3), 2, Step::SetTag(7, 5)),
        read(0, (4, 5), true, 2, &[(7, 1)]),
    ];
    assert_eq!(rejected(&tag), [Violation::NoPrefix { read: 2, id: 7 }]);
}

#[test]
fn a_write_applied_twice_is_rejected() {
    let mut seen = read(1, (2, 3), true, 2, &[(7, 1)]);
    let Call::Read {
        seen: ReadPoints::All(points),
        ..
    } = &mut seen.call
    else {
        unreachable!("a read of all points")
    };
    points.insert(8, stored_point(7, 2));
    let two_ids = [put(0, (0, 1), 1, 7), seen.clone()];
    let twice = [Violation::Twice { revision: 2, id: 8 }];
    assert_eq!(rejected(&two_ids), twice);
    let step = Step::Put {
        id: None,
        tag: 0,
        payload: 7,
    };
    assert_eq!(rejected(&[unknown(0, 0, vec![step]), seen]), twice);
    let stored_again = [put(0, (0, 1), 1, 7), read(1, (2, 3), true, 2, &[(7, 2)])];
    let twice = [Violation::Twice { revision: 2, id: 7 }];
    assert_eq!(rejected(&stored_again), twice);
}

#[test]
fn a_stale_read_of_the_latest_is_rejected_and_a_plain_one_is_not() {
    let stale = |latest| [put(0, (0, 1), 1, 7), read(1, (2, 3), latest, 0, &[])];
    let violation = Violation::Stale {
        revision: 0,
        returned: 1,
    };
    assert_eq!(rejected(&stale(true)), [violation]);
    assert!(check(&stale(false)).is_ok());
}

#[test]
fn an_old_answer_without_effect_is_rejected() {
    let unchanged = unchanged(1, (2, 3), 0, Step::Remove(9));
    let violation = Violation::Stale {
        revision: 0,
        returned: 1,
    };
    assert_eq!(rejected(&[put(0, (0, 1), 1, 7), unchanged]), [violation]);
}

#[test]
fn an_answer_without_effect_that_leaves_a_stored_point_is_rejected() {
    let history = [
        put(0, (0, 1), 1, 7),
        unchanged(1, (2, 3), 1, Step::Remove(7)),
        read(2, (4, 5), true, 1, &[(7, 1)]),
    ];
    let violation = Violation::Lost {
        read: 1,
        id: 7,
        revision: 1,
    };
    assert_eq!(rejected(&history), [violation]);
    let tag = [
        put(0, (0, 1), 1, 7),
        unchanged(1, (2, 3), 1, Step::SetTag(7, 5)),
    ];
    rejected(&tag);
    // Another removal may have come first.
    let removed = [
        put(0, (0, 1), 1, 7),
        unknown(1, 2, vec![Step::Remove(7)]),
        unchanged(2, (3, 4), 2, Step::Remove(7)),
        unchanged(2, (5, 6), 2, Step::SetTag(7, 5)),
    ];
    assert_eq!(check(&removed).map(|it| it.found), Ok(1));
}

#[test]
fn an_order_against_real_time_is_rejected() {
    let violation = Violation::Reordered {
        revision: 1,
        returned: 2,
    };
    let mutations = [put(0, (0, 1), 2, 7), put(1, (2, 3), 1, 8)];
    assert_eq!(rejected(&mutations), std::slice::from_ref(&violation));
    // The read has seen what was not yet asked for.
    let future = [read(0, (0, 1), false, 2, &[(7, 1)]), put(1, (2, 3), 1, 7)];
    assert_eq!(rejected(&future), [violation]);
}

#[test]
fn a_read_that_is_no_prefix_is_rejected() {
    let history = [
        put(0, (0, 1), 1, 7),
        put(0, (2, 3), 2, 8),
        read(1, (4, 5), false, 1, &[(7, 1), (8, 2)]),
    ];
    assert_eq!(rejected(&history), [Violation::NoPrefix { read: 1, id: 8 }]);
}

#[test]
fn answers_of_one_revision_with_other_contents_are_rejected() {
    let two_writes = [put(0, (0, 10), 1, 7), put(1, (0, 10), 1, 8)];
    let divergent = [Violation::Divergent { revision: 1 }];
    assert_eq!(rejected(&two_writes), divergent);
    let mut other = read(2, (2, 3), false, 1, &[(7, 1)]);
    let Call::Read { seen, .. } = &mut other.call else {
        unreachable!("a read")
    };
    let point = Point {
        state: 1,
        ..stored_point(7, 1)
    };
    *seen = ReadPoints::These(BTreeMap::from([(7, point)]));
    let two_reads = [
        put(0, (0, 1), 1, 7),
        read(1, (2, 3), false, 1, &[(7, 1)]),
        other,
    ];
    assert_eq!(rejected(&two_reads), divergent);
}

#[test]
fn a_client_that_goes_backwards_is_rejected() {
    let reads = |second| {
        [
            put(0, (0, 1), 1, 7),
            read(1, (2, 3), false, 1, &[(7, 1)]),
            read(second, (4, 5), false, 0, &[]),
        ]
    };
    let violation = Violation::Backwards {
        client: 1,
        from: 1,
        to: 0,
    };
    assert_eq!(rejected(&reads(1)), [violation]);
    assert!(check(&reads(2)).is_ok());
}

#[test]
fn an_unknown_removal_takes_effect_once_and_whole() {
    let removal = unknown(1, 2, vec![Step::Remove(7), Step::Remove(8)]);
    let history = |removed: &[(u64, u64)], after: &[(u64, u64)]| {
        [
            put(0, (0, 1), 1, 7),
            put(0, (2, 3), 2, 8),
            removal.clone(),
            read(0, (4, 5), true, 3, &[(7, 1), (8, 2)]),
            read(0, (6, 7), true, 4, removed),
            read(0, (8, 9), true, 5, after),
        ]
    };
    assert_eq!(check(&history(&[], &[])).map(|it| it.found), Ok(1));
    let never = history(&[(7, 1), (8, 2)], &[(7, 1), (8, 2)]);
    assert_eq!(check(&never).map(|it| it.found), Ok(0));
    rejected(&history(&[(8, 2)], &[(8, 2)]));
    rejected(&history(&[], &[(7, 1)]));
}

#[test]
fn an_unknown_removal_has_a_greater_revision_than_all_that_had_returned() {
    let history = |revision, points: &[(u64, u64)]| {
        [
            put(0, (0, 1), 1, 7),
            put(0, (2, 3), 2, 8),
            unknown(1, 4, vec![Step::Remove(7)]),
            read(2, (5, 6), false, revision, points),
        ]
    };
    let violation = Violation::Lost {
        read: 1,
        id: 7,
        revision: 1,
    };
    assert_eq!(rejected(&history(1, &[])), [violation]);
    assert_eq!(check(&history(3, &[(8, 2)])).map(|it| it.found), Ok(1));
}

#[test]
fn half_of_an_unknown_write_is_rejected() {
    let steps = [7, 8].map(|payload| Step::Put {
        id: None,
        tag: 0,
        payload,
    });
    let half = [
        unknown(0, 0, steps.to_vec()),
        read(1, (2, 3), true, 2, &[(7, 1)]),
    ];
    assert_eq!(rejected(&half), [Violation::Torn { revision: 1 }]);
    let whole = [
        unknown(0, 0, steps.to_vec()),
        read(1, (2, 3), true, 2, &[(7, 1), (8, 1)]),
    ];
    assert_eq!(check(&whole).map(|it| it.found), Ok(1));
}

fn cases(cases: u32) -> ProptestConfig {
    ProptestConfig {
        rng_seed: RngSeed::Fixed(cases.into()),
        failure_persistence: None,
        ..ProptestConfig::with_cases(cases)
    }
}

fn requests() -> impl Strategy<Value = Vec<Request>> {
    prop::collection::vec(store::request(), 1..60)
}

proptest! {
    #![proptest_config(cases(512))]

    #[test]
    fn all_that_a_store_with_one_order_answers_is_accepted(requests in requests(), is_followed in any::<bool>()) {
        let (history, unknown) = Store::new(is_followed).serve(&requests, None);
        let checked = check(&history);
        prop_assert!(checked.as_ref().is_ok_and(|it| it.found <= unknown), "{checked:?}");
    }

    #[test]
    fn a_store_that_forgets_a_write_is_rejected(requests in requests(), at in 0..20_usize) {
        let mut store = Store::new(false);
        let (history, _) = store.serve(&requests, Some((at, Fault::Forget)));
        prop_assume!(store.has_failed);
        prop_assert!(check(&history).is_err());
    }

    #[test]
    fn a_store_that_writes_twice_is_rejected(requests in requests(), at in 0..20_usize) {
        let mut store = Store::new(false);
        let (history, _) = store.serve(&requests, Some((at, Fault::Double)));
        prop_assume!(store.has_failed);
        prop_assert!(check(&history).is_err());
    }

    #[test]
    fn a_store_that_overwrites_is_rejected(requests in requests(), at in 0..20_usize) {
        // Nothing else tells of a change without an answer that was overwritten.
        let mut store = Store::new(true);
        let (history, _) = store.serve(&requests, Some((at, Fault::Overwrite)));
        prop_assume!(store.has_failed);
        prop_assert!(check(&history).is_err());
    }

    #[test]
    fn a_store_that_answers_from_the_past_is_rejected(requests in requests(), at in 0..20_usize) {
        let mut store = Store::new(false);
        let (history, _) = store.serve(&requests, Some((at, Fault::Past)));
        prop_assume!(store.has_failed);
        prop_assert!(check(&history).is_err());
    }
}
