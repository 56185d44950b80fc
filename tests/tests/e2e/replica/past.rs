//! Writers, and what they did at each revision: what every answer of a replica is compared with.

use std::{
    collections::BTreeMap,
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold::{Client, Found, IndexHandle, Replica, RetryPolicy, Search};
use wayfold_index::{Filter, Linear, PointRef, Space};
use wayfold_tests::{States, bits};

/// What one mutation did.
pub(super) enum Change {
    Stored {
        ids: Vec<u64>,
        rows: Vec<f64>,
        tag: u64,
    },
    Tagged {
        ids: Vec<u64>,
        tag: u64,
    },
    Removed {
        ids: Vec<u64>,
    },
}

/// What was done, by the revision that it made.
pub(super) type Past = BTreeMap<u64, Change>;

/// A question, and what a replica answered.
pub(super) struct Answered {
    pub(super) state: Vec<f64>,
    pub(super) search: Search<'static>,
    pub(super) found: Found,
}

/// A client that waits for its server, however long that is away.
pub(super) async fn client(uri: &str) -> Client {
    let patient = Client::builder()
        .timeout(Duration::from_secs(120))
        .retry(RetryPolicy::until_deadline());
    patient.connect(uri).await.unwrap()
}

/// Makes so many mutations, each of which changes something, of points of its own.
pub(super) async fn write(index: IndexHandle, name: u64, calls: u64) -> Past {
    let mut random = ChaCha8Rng::seed_from_u64(100 + name);
    let mut states = States::new(index.space().clone(), name);
    let mut mine: Vec<u64> = Vec::new();
    let mut past = Past::new();
    for call in 0..calls {
        // No two mutations give the same tag.
        let tag = call << 8 | name << 4 | random.random_range(0..16);
        let few = random.random_range(1..=5).min(mine.len());
        let (revision, change) = match random.random_range(0..10) {
            0 | 1 if few > 0 => {
                let ids = mine.split_off(mine.len() - few);
                let removed = index.remove(ids.clone()).await.unwrap();
                (removed.revision, Change::Removed { ids })
            }
            2 | 3 if few > 0 => {
                let ids = mine[..few].to_vec();
                let updated = index.update(ids.clone()).tags([tag]).await.unwrap();
                (updated.revision, Change::Tagged { ids, tag })
            }
            kind => {
                // Sometimes those that are stored already; sometimes more than a message of a feed holds.
                let count = if call % 50 == 17 {
                    6_000
                } else {
                    random.random_range(1..=20)
                };
                let first = match kind {
                    4 => name << 32,
                    _ => name << 32 | call << 16,
                };
                let ids: Vec<u64> = (first..first + count).collect();
                let rows = states.rows(ids.len());
                let width = index.coordinates();
                let insert = index.insert(rows.chunks(width)).ids(ids.clone());
                let insert = insert.tags(vec![tag; ids.len()]);
                let inserted = insert.replace().await.unwrap();
                mine.retain(|id| !ids.contains(id));
                mine.extend(&ids);
                (inserted.revision, Change::Stored { ids, rows, tag })
            }
        };
        assert!(past.insert(revision, change).is_none());
    }
    past
}

/// Some search of the kinds that there are, by filters that have something to do.
pub(super) fn question(random: &mut ChaCha8Rng, revision: u64) -> Search<'static> {
    let mut search = match random.random_range(0..3) {
        0 => Search::nearest_k(1),
        1 => Search::nearest_k(random.random_range(2..20)),
        _ => Search::nearest_r(random.random_range(0.0..1.5)),
    };
    search.filter = match random.random_range(0..3) {
        0 => Filter::default(),
        1 => Filter {
            tag_mask: 3,
            tag_value: random.random_range(0..4),
            ..Filter::default()
        },
        _ => Filter {
            since_revision: revision / 2,
            ..Filter::default()
        },
    };
    search
}

/// Asks on until it is told to stop; keeps at most one answer for each revision that it saw.
pub(super) fn ask(replica: &Replica, space: Space, seed: u64, stop: &AtomicBool) -> Vec<Answered> {
    let mut states = States::new(space, 1_000 + seed);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut answers: Vec<Answered> = Vec::new();
    while !stop.load(Ordering::Relaxed) {
        let state = states.row();
        let search = question(&mut random, replica.revision());
        let found = replica.search(&state[..], &search).unwrap();
        let last = answers.last().map(|last| last.found.revision);
        assert!(last <= Some(found.revision), "it went back from {last:?}");
        if last != Some(found.revision) {
            answers.push(Answered {
                state,
                search,
                found,
            });
        }
    }
    answers
}

/// A replica has the points that there are, and no others.
pub(super) fn compare(replica: &Replica, points: &Linear) {
    let view = replica.view().unwrap();
    assert_eq!(view.len(), points.len());
    for expected in points.iter() {
        let point = view.get(expected.id).unwrap();
        assert_eq!(bits(&point.row), bits(expected.row));
        assert_eq!(
            (point.tag, point.revision),
            (expected.tag, expected.revision)
        );
    }
}

/// Replays the past and compares each answer with brute force at its revision. Returns what is there in the end.
pub(super) fn check(space: &Space, past: &Past, mut answers: Vec<Answered>) -> Linear {
    answers.sort_by_key(|answered| answered.found.revision);
    let mut answers = answers.into_iter().peekable();
    let mut points = Linear::new(space.clone());
    let mut compare = |revision: u64, points: &Linear| {
        while let Some(answered) = answers.next_if(|next| next.found.revision == revision) {
            let mut state = answered.state;
            space.canonicalize(&mut state).unwrap();
            let expected = points.search(&state, &answered.search).unwrap().neighbors;
            let pairs = |found: &[wayfold_index::Neighbor]| {
                let pairs = found.iter().map(|n| (n.id, n.distance.to_bits()));
                pairs.collect::<Vec<_>>()
            };
            let found = &answered.found.neighbors;
            assert_eq!(
                pairs(found),
                pairs(&expected),
                "{:?} at {revision}",
                answered.search
            );
            assert!(answered.found.exact);
        }
    };
    compare(0, &points);
    for (expected, (&revision, change)) in (1..).zip(past) {
        assert_eq!(revision, expected, "a revision that nobody made");
        apply(&mut points, revision, change);
        compare(revision, &points);
    }
    assert!(
        answers.next().is_none(),
        "an answer of a revision that nobody made"
    );
    points
}

fn apply(points: &mut Linear, revision: u64, change: &Change) {
    let space = points.space().clone();
    match change {
        Change::Stored { ids, rows, tag } => {
            for (&id, row) in ids.iter().zip(rows.chunks(space.coordinates())) {
                let mut row = row.to_vec();
                space.canonicalize(&mut row).unwrap();
                points
                    .insert(PointRef {
                        id,
                        tag: *tag,
                        revision,
                        row: &row,
                    })
                    .unwrap();
            }
        }
        Change::Tagged { ids, tag } => {
            for &id in ids {
                let point = points.get(id).unwrap();
                let (row, stored) = (point.row.to_vec(), point.revision);
                points
                    .insert(PointRef {
                        id,
                        tag: *tag,
                        revision: stored,
                        row: &row,
                    })
                    .unwrap();
            }
        }
        Change::Removed { ids } => {
            for &id in ids {
                assert!(points.remove(id));
            }
        }
    }
}
