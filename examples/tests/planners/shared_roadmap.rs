//! The roadmap of several workers equals that of a single worker which draws the same states in the same order, by a
//! comparison with brute force for each milestone. The workers are those of the program `rigid`.

use std::{collections::BTreeSet, sync::LazyLock};

use wayfold::IndexHandle;
use wayfold_examples::{
    planning::{options::Source, path, problem::Problem},
    rigid::{
        milestone::{self, PENDING},
        replay::{self, stored},
        roadmap::Roadmap,
        scene::Rooms,
        worker::{CheckedState, Worker},
    },
};

use crate::server::Server;

static SCENE: LazyLock<Rooms> = LazyLock::new(Rooms::new);
const SPACE: &str = "R3*SO3:0.15";
const SEED: u64 = 7;

/// The number of milestones at which each of four workers waits for the place of one.
const MAX_PENDING: [usize; 4] = [1, 3, 8, 3];

/// A worker with a connection of its own.
async fn worker(server: &Server, number: usize, source: Source) -> Worker<'static> {
    let opened = Worker::open(&SCENE, (&server.uri, "roadmap"), source, number, SEED);
    opened.await.unwrap()
}

/// The expected edges of each milestone, as one worker would make them in the index's order.
fn replayed(roadmap: &Roadmap) -> Vec<BTreeSet<u64>> {
    replay::edges(&SCENE, roadmap)
}

/// Extends the roadmap by concurrent workers.
async fn extend(workers: Vec<Worker<'static>>, milestones: u64) -> u64 {
    let tasks = workers.into_iter().map(|mut worker| {
        tokio::spawn(async move {
            let done = worker.extend(milestones, |_| Ok(())).await;
            done.map(|()| worker.account().meanwhile)
        })
    });
    let mut meanwhile = 0;
    for task in tasks.collect::<Vec<_>>() {
        meanwhile += task.await.unwrap().unwrap();
    }
    meanwhile
}

async fn read(index: &IndexHandle) -> Roadmap {
    index.info().await.unwrap();
    Roadmap::read(index).await.unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn four_workers_build_what_one_would() {
    let server = Server::start();
    let index = server.index("roadmap", SPACE).await;
    let mut workers = Vec::new();
    for (number, max_pending) in MAX_PENDING.into_iter().enumerate() {
        let source = [Source::Shared, Source::Remote][number % 2];
        let worker = worker(&server, number, source).await;
        workers.push(worker.max_pending(max_pending));
    }
    // Each worker searches before any inserts, so in any schedule all milestones but the first have neighbours that
    // their searches did not find.
    let mut looked = Vec::new();
    for worker in &mut workers {
        let states = [worker.sample(), worker.sample()];
        looked.push(states.map(|state| worker.look(state).unwrap().unwrap()));
    }
    for (worker, states) in workers.iter_mut().zip(looked) {
        for checked in states {
            worker.insert(checked).await.unwrap();
        }
    }
    for worker in &mut workers {
        while worker.account().milestones < 2 {
            worker.settle(true).await.unwrap();
        }
    }
    let met: u64 = workers.iter().map(|one| one.account().meanwhile).sum();
    assert!(met >= 7, "each but the first has met another");
    extend(workers, 150).await;

    let roadmap = read(&index).await;
    let surplus = MAX_PENDING.iter().sum::<usize>();
    assert!((150..=150 + surplus).contains(&roadmap.len()));
    assert!(!roadmap.pending.contains(&true));
    assert_eq!(BTreeSet::from_iter(&roadmap.workers).len(), 4);
    assert_eq!(stored(&roadmap), replayed(&roadmap));

    // The roadmap answers the question, and a finer check by other code finds the path free.
    assert!(roadmap.edge_count() > 300);
    let last = roadmap.ids[roadmap.len() - 1];
    let found = roadmap.ids.iter();
    let found = found.filter_map(|&id| roadmap.path(SCENE.space(), id, last));
    let longest = found.max_by_key(Vec::len).unwrap();
    assert!(longest.len() > 3);
    path::verify(&*SCENE, &longest).unwrap();
}

#[test]
fn the_questions_begin_and_end_in_free_states() {
    for task in SCENE.tasks() {
        for state in [&task.start, &task.goal] {
            assert!(SCENE.is_free(state), "{}: {state:?}", task.name);
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_worker_that_dies_leaves_no_milestone_without_its_edges() {
    let server = Server::start();
    let index = server.index("roadmap", SPACE).await;
    let mut doomed = worker(&server, 0, Source::Remote).await;
    let mut other = worker(&server, 1, Source::Shared).await;
    // The states are so many that each milestone has the next among its neighbours, and k(n) grows meanwhile.
    for _ in 0..40 {
        let state = other.sample();
        other.add(state).await.unwrap().unwrap();
    }
    // A worker that dies before it inserts leaves nothing behind.
    let state = doomed.sample();
    drop(doomed.look(state).unwrap());
    // A worker dies after it inserted several by one call; other milestones arrived meanwhile, the first of them next
    // to one of these.
    let states: Vec<_> = (0..3).map(|_| doomed.sample()).collect();
    let checked = states.iter().map(|state| doomed.look(state.clone()));
    let checked: Vec<CheckedState> = checked.map(|checked| checked.unwrap().unwrap()).collect();
    let mut neighbor = states[1].clone();
    neighbor[0] += 1e-3;
    other.add(neighbor).await.unwrap().unwrap();
    for _ in 0..20 {
        let state = other.sample();
        other.add(state).await.unwrap().unwrap();
    }
    drop(doomed);
    let edges = checked
        .iter()
        .map(|checked| milestone::payload(&checked.edges()));
    let insert = index.insert(checked.iter().map(|checked| &checked.state));
    let insert = insert.tags([PENDING; 3]).payloads(edges);
    insert.await.unwrap();
    // The other workers see its milestones and go on.
    let third = worker(&server, 2, Source::Remote).await;
    extend(vec![other.max_pending(4), third], 90).await;

    let roadmap = read(&index).await;
    let pending = (0..roadmap.len()).filter(|&at| roadmap.pending[at]);
    let pending: Vec<usize> = pending.collect();
    assert_eq!(pending, [61, 62, 63], "those of one call were left pending");
    let (mut as_left, serial) = (stored(&roadmap), replayed(&roadmap));
    let neighbor = roadmap.ids[40];
    assert!(!as_left[62].contains(&neighbor), "the one beside it");
    assert!(serial[62].contains(&neighbor));
    // All stored edges are free, and no other edge is missing.
    for id in pending {
        for &to in &roadmap.edges[id] {
            let (state, other) = (roadmap.states.row(id), roadmap.states.row(to));
            path::verify(&*SCENE, &[state.to_vec(), other.to_vec()]).unwrap();
        }
        as_left[id].clone_from(&serial[id]);
    }
    assert_eq!(as_left, serial);

    let mut heir = worker(&server, 3, Source::Remote).await;
    assert_eq!(heir.adopt(None).await.unwrap(), 3);
    let roadmap = read(&index).await;
    assert!(!roadmap.pending.contains(&true));
    assert_eq!(stored(&roadmap), serial);
    assert_eq!(heir.adopt(None).await.unwrap(), 0);
}

#[tokio::test]
async fn a_sparse_roadmap_has_no_two_milestones_too_near_to_each_other() {
    let server = Server::start();
    let index = server.index("roadmap", SPACE).await;
    let first = worker(&server, 0, Source::Remote).await;
    let second = worker(&server, 1, Source::Shared).await;
    let sparse = [first, second].map(|worker| worker.min_separation(1.2));
    extend(sparse.into(), 60).await;

    let roadmap = read(&index).await;
    let states: Vec<&[f64]> = roadmap.states.iter().collect();
    let mut least = f64::INFINITY;
    for (at, a) in states.iter().enumerate() {
        for b in &states[..at] {
            least = least.min(SCENE.space().distance(a, b));
        }
    }
    assert!(least >= 1.2);
    assert_eq!(roadmap.separation(SCENE.space(), 2), Some(least));
    assert_eq!(stored(&roadmap), replayed(&roadmap));
}
