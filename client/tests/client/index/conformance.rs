//! One suite over the forms, the spaces and the operations.

use std::{
    collections::HashMap,
    sync::atomic::{AtomicBool, Ordering::Relaxed},
    time::Duration,
};

use wayfold::{
    Code, Error, Index, InsertOptions, PayloadEncoding, ScaledRadius, Search, Space, StateProblem,
};

use super::model::Model;

/// The spaces of the suite.
pub(crate) const SPACES: [&str; 8] = [
    "R1",
    "R3",
    "SO2^3",
    "SO3",
    "R2*SO2",
    "R3*SO3:0.15",
    "sum(R3, SO3)",
    "(R3*RP3:0.15)^2",
];

/// Every answer equals brute force.
pub(crate) fn equals_brute_force(make: impl Fn(&Space) -> Index, steps: usize) {
    for (seed, space) in SPACES.iter().enumerate() {
        let index = make(&space.parse().unwrap());
        Model::new(index, seed as u64).run(steps);
    }
}

/// A state that is none of the space changes nothing, and the error says why.
pub(crate) fn refuses_what_is_no_state(make: impl Fn(&Space) -> Index) {
    let index = make(&Space::se3());
    let good = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    index.insert(good).unwrap();
    let short = index.insert([0.0; 3]).unwrap_err();
    assert!(
        matches!(
            short,
            Error::Width {
                row: 0,
                expected: 7,
                found: 3
            }
        ),
        "{short}"
    );
    let nan = index.insert_many([good, [0.0, f64::NAN, 0.0, 0.0, 0.0, 0.0, 1.0]]);
    let nan = nan.unwrap_err();
    assert_eq!(nan.to_string(), "states[1].coords[1]: NaN");
    assert!(
        matches!(&nan, Error::State { row: 1, error } if error.reason == StateProblem::NaN),
        "{nan}"
    );
    let shifted = index
        .nearest([0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 7.0])
        .unwrap_err();
    assert!(matches!(shifted, Error::State { row: 0, .. }), "{shifted}");
    let arguments = [
        (Search::k(0), "k"),
        (Search::k_factor(f64::NAN), "k_factor"),
        (Search::k_factor(-1.0), "k_factor"),
        (Search::within(-1.0), "radius"),
        (
            Search::within(ScaledRadius::new(f64::INFINITY)),
            "scaled_radius.factor",
        ),
        (
            Search::within(ScaledRadius::new(1.0).max(-1.0)),
            "scaled_radius.max",
        ),
        (Search::k(1).epsilon(f64::INFINITY), "epsilon"),
        (Search::k(1).tag(0b1, 0b10), "tag"),
    ];
    for (search, name) in arguments {
        let error = index.search(good, &search).unwrap_err();
        assert!(
            matches!(error, Error::Argument { field, .. } if field == name),
            "{name}: {error}"
        );
    }
    let id = index.insert_with(good, InsertOptions::new().id(1 << 63));
    assert!(
        matches!(id, Err(Error::Argument { field: "id", .. })),
        "{id:?}"
    );
    assert_eq!(index.len().unwrap(), 1);
}

/// An index tells the encoding of payloads that its creator declared, whatever a later caller declares, and refuses another.
/// `open` creates the index of a name if it gets an encoding.
pub(crate) fn declares_its_payloads(
    open: impl Fn(&str, Option<PayloadEncoding>) -> Result<Index, Error>,
) {
    use PayloadEncoding::{Edges, Unspecified, WeightedEdges};
    for (name, declared, later) in [
        ("edges", Edges, Unspecified),
        ("weighted", WeightedEdges, WeightedEdges),
        ("undeclared", Unspecified, Edges),
    ] {
        for caller in [Some(declared), Some(later), None] {
            let index = open(name, caller).unwrap();
            assert_eq!(index.payload_encoding(), declared, "{name}, {caller:?}");
        }
    }
    let refused = open("edges", Some(WeightedEdges)).unwrap_err();
    assert_eq!(refused.code(), Code::AlreadyExists, "{refused}");
}

/// A search that is out of time says so.
pub(crate) fn ends_a_search_that_takes_too_long(make: impl Fn(&Space) -> Index) {
    const POINTS: usize = 4_000;
    let index = make(&"R1".parse().unwrap());
    index.insert_many((0..POINTS).map(|x| [x as f64])).unwrap();
    let all = Search::within(f64::INFINITY);
    assert_eq!(index.search([0.0], &all).unwrap().neighbors.len(), POINTS);
    let late = index.search([0.0], &all.timeout(Duration::ZERO));
    assert!(matches!(late, Err(Error::SearchTimeout)), "{late:?}");
}

/// Beside a writer, the answers to many states and those to the same search about later points leave out no point.
pub(crate) fn answers_tell_what_they_have_read(make: impl Fn(&Space) -> Index) {
    // A remote index divides them into several calls.
    const STATES: usize = 2_500;
    const ROUNDS: usize = 3;
    const MAX_INSERTS: usize = 20_000;
    let index = make(&"R1".parse().unwrap());
    let insert = |x: usize| index.insert([x as f64]).unwrap();
    let first = insert(0);
    let is_done = AtomicBool::new(false);
    let (ids, answers) = std::thread::scope(|scope| {
        let writer = scope.spawn(|| {
            let inserts = (1..MAX_INSERTS).take_while(|_| !is_done.load(Relaxed));
            let ids: Vec<u64> = inserts.map(insert).collect();
            ids
        });
        // The newest point is the nearest one.
        let newest = || index.search_many([[1e9]; STATES], &Search::k(1)).unwrap();
        let answers: Vec<_> = (0..ROUNDS).flat_map(|_| newest()).collect();
        is_done.store(true, Relaxed);
        (writer.join().unwrap(), answers)
    });
    let ids = [vec![first], ids, vec![insert(MAX_INSERTS)]].concat();
    assert_eq!(answers.len(), ROUNDS * STATES);
    let mut checked = HashMap::new();
    for answer in answers {
        let last = answer.neighbors[0].id;
        let next = checked.entry(answer.read_revision).or_insert_with(|| {
            let later = Search::k(1).since(answer.read_revision);
            index.search([-1.0], &later).unwrap().neighbors[0].id
        });
        let at = ids.iter().position(|id| *id == last).unwrap();
        assert_eq!(*next, ids[at + 1]);
    }
}

/// The later of any two inserts that ask finds the earlier one, on any threads.
pub(crate) fn misses_no_edge(make: impl Fn(&Space) -> Index) {
    const THREADS: usize = 4;
    const INSERTS: usize = 250;
    let index = make(&"R1".parse().unwrap());
    let all = InsertOptions::new().neighbors(Search::within(f64::INFINITY));
    let found: Vec<(u64, Vec<u64>)> = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..THREADS)
            .map(|thread| {
                let index = &index;
                scope.spawn(move || {
                    let insert = |at: usize| {
                        let state = [(thread * INSERTS + at) as f64];
                        let inserted = index.insert_with(state, all).unwrap();
                        let ids = inserted.neighbors.neighbors.iter().map(|found| found.id);
                        (inserted.id, ids.collect())
                    };
                    (0..INSERTS).map(insert).collect::<Vec<_>>()
                })
            })
            .collect();
        threads
            .into_iter()
            .flat_map(|thread| thread.join().unwrap())
            .collect()
    });
    let mut sizes: Vec<usize> = found.iter().map(|(_, before)| before.len()).collect();
    sizes.sort_unstable();
    assert!(sizes.into_iter().eq(0..THREADS * INSERTS));
    let mut ids: Vec<u64> = found.iter().map(|(id, _)| *id).collect();
    ids.sort_unstable();
    ids.dedup();
    assert_eq!(ids.len(), THREADS * INSERTS);
}
