//! `neighbors`: of any two inserts, the later one saw the earlier one.

use std::{
    collections::BTreeSet,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

use tokio::{sync::Barrier, task::JoinSet};
use wayfold_index::Space;
use wayfold_proto::v1::{
    Filter, InsertRequest, NeighborSpec, QueryRequest, neighbor_spec, query_request,
};
use wayfold_tests::{States, Stubs, neighbor_rows, number, revision, row_states, server};

const WORKERS: u64 = 48;
const PAIRS: usize = 10_000;
/// The maximum number of rounds; any scheduling reaches that many concurrent pairs in fewer.
const ROUNDS: u64 = 60;

/// One insert, and the answers that its worker received.
struct InsertRecord {
    /// The ticks of a clock that all workers share, just before the call and just after its answer.
    called: u64,
    answered: u64,
    revision: u64,
    id: u64,
    /// The answer of a read before the insert, with its revision.
    before: Option<(u64, BTreeSet<u64>)>,
    neighbors: BTreeSet<u64>,
}

#[tokio::test(flavor = "multi_thread")]
async fn the_later_of_two_inserts_saw_the_earlier() {
    check(&inserts(false).await);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_insert_reports_points_that_arrived_after_an_earlier_read() {
    let records = inserts(true).await;
    check(&records);
    let meanwhile = records
        .iter()
        .map(|insert| insert.neighbors.len())
        .sum::<usize>();
    assert!(
        meanwhile > 0,
        "nothing arrived between a read and its insert"
    );
}

/// Every point is a neighbour of every other. An insert must therefore have returned exactly the ids that were stored
/// by the revisions before its own.
fn check(records: &[InsertRecord]) {
    let mut by_revision: Vec<&InsertRecord> = records.iter().collect();
    by_revision.sort_by_key(|insert| insert.revision);
    let mut stored = BTreeSet::new();
    for (i, insert) in by_revision.iter().enumerate() {
        assert_eq!(insert.revision, i as u64 + 1, "a revision each");
        let mut seen = insert.neighbors.clone();
        if let Some((revision, before)) = &insert.before {
            let earlier = by_revision[..*revision as usize].iter().map(|e| e.id);
            assert_eq!(*before, earlier.collect(), "the read at {revision}");
            assert!(seen.is_disjoint(before), "since_revision lets old ones by");
            seen.extend(before);
        }
        assert_eq!(seen, stored, "the insert of revision {}", insert.revision);
        stored.insert(insert.id);
    }
    let concurrent = concurrent_pairs(records);
    assert!(
        concurrent >= PAIRS,
        "only {concurrent} pairs were concurrent"
    );
}

/// The number of pairs of concurrent calls.
fn concurrent_pairs(records: &[InsertRecord]) -> usize {
    let overlap =
        |a: &InsertRecord, b: &InsertRecord| a.called < b.answered && b.called < a.answered;
    let pairs = records.iter().enumerate();
    let of_one = pairs.map(|(i, a)| records[..i].iter().filter(|b| overlap(a, b)).count());
    of_one.sum()
}

/// Lets each worker insert one point a round, until enough calls were concurrent.
async fn inserts(read_before: bool) -> Vec<InsertRecord> {
    let server = server!();
    let mut stubs = Stubs::connect(server.uri()).await;
    let created = stubs.create("roadmap", "R3*SO3:0.15").await;
    let uid = created.revision.expect("a revision").uid;
    let clock = Arc::new(AtomicU64::new(0));
    let mut records = Vec::new();
    for round in 0..ROUNDS {
        let barrier = Arc::new(Barrier::new(WORKERS as usize));
        let mut workers = JoinSet::new();
        for worker in 0..WORKERS {
            let (stubs, uid) = (stubs.clone(), uid.clone());
            let (clock, barrier) = (clock.clone(), barrier.clone());
            let seed = round * WORKERS + worker;
            workers.spawn(async move {
                barrier.wait().await;
                insert(stubs, uid, seed, &clock, read_before).await
            });
        }
        records.extend(workers.join_all().await);
        if concurrent_pairs(&records) >= PAIRS {
            break;
        }
    }
    records
}

async fn insert(
    mut stubs: Stubs,
    uid: String,
    seed: u64,
    clock: &AtomicU64,
    read_before: bool,
) -> InsertRecord {
    let states = Some(row_states(&States::new(Space::se3(), seed).row(), 7));
    let mut before = None;
    if read_before {
        let request = QueryRequest {
            index_name: "roadmap".into(),
            states: states.clone(),
            radius_form: Some(query_request::RadiusForm::Radius(f64::INFINITY)),
            ..Default::default()
        };
        let response = stubs.points.query(request).await;
        let response = response.expect("neighbours").into_inner();
        let ids = response.neighbors.expect("neighbours").ids;
        before = Some((number(&response.revision), BTreeSet::from_iter(ids)));
    }
    let filter = before.as_ref().map(|(read_at, _)| Filter {
        since_revision: revision(&uid, *read_at),
        ..Default::default()
    });
    let request = InsertRequest {
        index_name: "roadmap".into(),
        states,
        neighbor_spec: Some(NeighborSpec {
            radius_form: Some(neighbor_spec::RadiusForm::Radius(f64::INFINITY)),
            filter,
            ..Default::default()
        }),
        uid,
        ..Default::default()
    };
    let called = clock.fetch_add(1, Ordering::SeqCst);
    let response = stubs.insert(request).await;
    let answered = clock.fetch_add(1, Ordering::SeqCst);
    let rows = neighbor_rows(&response.neighbors.expect("neighbours"));
    InsertRecord {
        called,
        answered,
        revision: number(&response.revision),
        id: response.ids[0],
        before,
        neighbors: rows[0].iter().map(|(id, _)| *id).collect(),
    }
}
