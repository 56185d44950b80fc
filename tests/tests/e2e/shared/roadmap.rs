//! The roadmap of four workers equals the one that a single worker builds of the same points in the index's order.

use std::{
    collections::BTreeMap,
    sync::{Arc, Barrier},
    thread,
};

use wayfold::{Client, Index, InsertOptions, Scaling, Search, WatchEvent};
use wayfold_index::{Linear, Neighbor, ScaledSearch, Space};
use wayfold_tests::{
    Process, ServerProcess, States,
    brute_force::{self, pairs},
};

use super::{command, history::take_answers, shared};

const SE3: &str = "R3*SO3:0.15";
const WORKERS: usize = 4;
const INSERTS: usize = 300;
const RADIUS: f64 = 3.0;
const K: usize = 8;

/// The neighbours of each point: those that its insert found, and those of `meanwhile`.
type Edges = BTreeMap<u64, Vec<Neighbor>>;

/// Inserts points from four threads; two of the threads share an index. Returns the neighbours of each point.
fn build(indexes: &[Index; WORKERS], ask: Search) -> Edges {
    let start = Arc::new(Barrier::new(WORKERS));
    let threads: Vec<_> = (0..)
        .zip(indexes)
        .map(|(seed, index)| {
            let (index, start) = (index.clone(), Arc::clone(&start));
            thread::spawn(move || {
                let mut states = States::new(index.space().clone(), seed);
                let mut edges = Edges::new();
                start.wait();
                for _ in 0..INSERTS {
                    let options = InsertOptions::new().neighbors(ask);
                    let inserted = index.insert_with(&states.row()[..], options).unwrap();
                    let old = edges.insert(inserted.id, inserted.neighbors.neighbors);
                    assert_eq!(old, None);
                }
                index.flush().unwrap();
                edges
            })
        })
        .collect();
    let edges = threads
        .into_iter()
        .flat_map(|thread| thread.join().unwrap());
    edges.collect()
}

/// The points with their ids, in the index's order.
async fn order(client: &Client) -> Vec<(u64, Vec<f64>)> {
    let index = client.index("arm").await.unwrap();
    let newest = index.info().await.unwrap().revision.number;
    let mut watch = index.watch().after(index.revision_at(0)).await.unwrap();
    let mut points = Vec::new();
    loop {
        let Some(WatchEvent::Mutation(mutation)) = watch.next().await.unwrap() else {
            panic!("the window is narrower than thought")
        };
        let stored = mutation.stored.iter();
        // The points of a batch come by their ids, which ascend in the order of the calls.
        points.extend(stored.map(|point| (point.id, point.state.to_vec())));
        if mutation.revision.number == newest {
            return points;
        }
    }
}

async fn check(ask: Search, search: wayfold_index::Search<'static>, scaling: Scaling) {
    let directory = tempfile::tempdir().unwrap();
    let mut command = command(&directory.path().join("data"), "127.0.0.1:0");
    let server = ServerProcess::ready(Process::spawn(&mut command));
    let space: Space = SE3.parse().unwrap();
    let [first, second, third] = [(); 3].map(|()| shared(server.uri(), &space));
    let indexes = [first, second, third.clone(), third];
    let mut edges = build(&indexes, ask);
    let client = Client::connect(server.uri()).await.unwrap();
    let order = order(&client).await;
    assert_eq!(order.len(), WORKERS * INSERTS);
    let (mut later, mut places) = (0, BTreeMap::new());
    for index in &indexes {
        for meanwhile in take_answers(index) {
            assert!(!meanwhile.is_superset);
            later += meanwhile.neighbors.len();
            places.insert(meanwhile.id, meanwhile.points_before);
            let known = edges.get_mut(&meanwhile.id).unwrap();
            known.extend(meanwhile.neighbors);
        }
    }
    let scaled = ScaledSearch { search, scaling };
    let dimension = space.dimension();
    let mut points = Linear::new(space);
    let mut all = 0;
    for (id, state) in order {
        let replayed = scaled.among(points.len(), dimension);
        let expected = brute_force::search(&points, &state, &replayed);
        assert_eq!(places[&id], points.len());
        let mut found = edges.remove(&id).unwrap();
        found.sort_unstable();
        // The insert's answer holds some that nearer ones displaced.
        found.truncate(replayed.k);
        assert_eq!(pairs(found), expected, "point {id}");
        all += expected.len();
        brute_force::store(&mut points, &[id], &state, 0, 1);
    }
    println!("{all} edges; {later} were told after the insert");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn four_workers_find_every_pair_within_the_radius_once() {
    let replayed = wayfold_index::Search {
        radius: RADIUS,
        ..wayfold_index::Search::nearest_k(usize::MAX)
    };
    check(Search::within(RADIUS), replayed, Scaling::default()).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn four_workers_find_the_nearest_that_one_would() {
    let replayed = wayfold_index::Search::nearest_k(K);
    check(Search::k(K as u32), replayed, Scaling::default()).await;
}

/// Each worker's copy has fewer points at the insert than the index has before the point.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn four_workers_find_as_many_as_one_would_by_the_size_of_the_index() {
    let scaling = Scaling {
        k_factor: Some(Scaling::K_FACTOR),
        ..Scaling::default()
    };
    let all = wayfold_index::Search::nearest_k(usize::MAX);
    check(Search::k_factor(Scaling::K_FACTOR), all, scaling).await;
}
