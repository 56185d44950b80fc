//! The roadmap of several workers equals that of a single worker which draws the same states in the same order, by a
//! comparison with brute force for each milestone. The workers are those of the program `rigid`.

use std::{collections::BTreeSet, sync::LazyLock};

use wayfold::IndexHandle;
use wayfold_examples::{
    planning::{path, problem::Problem},
    rigid::{
        nearby::Source,
        replay::{self, stored},
        roadmap::{self, Roadmap},
        scene::Rooms,
        worker::Worker,
    },
};

use crate::server::Server;

static SCENE: LazyLock<Rooms> = LazyLock::new(Rooms::new);
const SPACE: &str = "R3*SO3:0.15";
const SEED: u64 = 7;

/// The number of milestones that each of four workers inserts in one call.
const BATCHES: [usize; 4] = [1, 3, 1, 3];

/// A worker with a connection of its own.
async fn worker(server: &Server, number: usize, replica: bool) -> Worker<'static> {
    let client = server.client().await;
    let index = client.index("roadmap").await.unwrap();
    let source = match replica {
        true => Source::Replica(client.replica("roadmap").await.unwrap()),
        false => Source::Server,
    };
    Worker::new(&SCENE, index, source, number, SEED)
}

/// The expected edges of each milestone, as one worker would make them in the order of the revisions and of the rows of
/// each insert.
fn replayed(roadmap: &Roadmap) -> Vec<BTreeSet<u64>> {
    replay::edges(&SCENE, roadmap).unwrap()
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
    for number in 0..4 {
        workers.push(worker(&server, number, number % 2 == 0).await);
    }
    // Each worker searches before any inserts, so in any schedule the inserts of all but one report another's
    // milestones, and the later rows of a batch report the earlier ones.
    let mut looked = Vec::new();
    for (worker, batch) in workers.iter_mut().zip(BATCHES) {
        let states = (0..batch).map(|_| worker.sample()).collect();
        looked.push(worker.look(states).await.unwrap());
    }
    for (worker, checked) in workers.iter_mut().zip(looked) {
        let pending = worker.insert(checked).await.unwrap();
        worker.complete(pending).await.unwrap();
    }
    let first: u64 = BATCHES.iter().sum::<usize>() as u64;
    let met: u64 = workers.iter().map(|one| one.account().meanwhile).sum();
    assert!(met >= first - 1, "each but the first has met another");
    let workers = workers.into_iter().zip(BATCHES);
    let workers = workers.map(|(worker, batch)| worker.batch(batch));
    extend(workers.collect(), 150).await;

    let roadmap = read(&index).await;
    assert!((150..=158).contains(&roadmap.len()));
    assert!(!roadmap.pending.contains(&true));
    let shared = roadmap.revisions.windows(3);
    let shared = shared.filter(|of| of[0] == of[2]).count();
    assert!(shared >= 2, "rows of one insert");
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
    let (mut doomed, mut other) = (
        worker(&server, 0, false).await,
        worker(&server, 1, true).await,
    );
    // The states are so many that each milestone has the next among its neighbours, and k(n) grows meanwhile.
    for _ in 0..40 {
        let state = other.sample();
        other.add(state).await.unwrap().unwrap();
    }
    // A worker that dies before it inserts leaves nothing behind.
    let states = vec![doomed.sample(), doomed.sample()];
    drop(doomed.look(states).await.unwrap());
    // A worker dies after it inserted a batch; other milestones arrived meanwhile, the first of them next to one of the
    // batch.
    let states: Vec<_> = (0..3).map(|_| doomed.sample()).collect();
    let checked = doomed.look(states.clone()).await.unwrap();
    let mut beside = states[1].clone();
    beside[0] += 1e-3;
    other.add(beside).await.unwrap().unwrap();
    for _ in 0..20 {
        let state = other.sample();
        other.add(state).await.unwrap().unwrap();
    }
    assert_eq!(doomed.insert(checked).await.unwrap().len(), 3);
    drop(doomed);
    // The other workers see its milestones and go on.
    let third = worker(&server, 2, false).await;
    extend(vec![other.batch(4), third], 90).await;

    let roadmap = read(&index).await;
    let pending = (0..roadmap.len()).filter(|&at| roadmap.pending[at]);
    let pending: Vec<usize> = pending.collect();
    assert_eq!(pending, [61, 62, 63], "a batch was left pending");
    let (mut as_left, serial) = (stored(&roadmap), replayed(&roadmap));
    assert!(!as_left[62].contains(&40), "the one beside it");
    assert!(serial[62].contains(&40));
    // All stored edges are free, and no other edge is missing.
    for id in pending {
        for &to in &as_left[id] {
            let (state, other) = (roadmap.states.row(id), roadmap.states.row(to as usize));
            path::verify(&*SCENE, &[state.to_vec(), other.to_vec()]).unwrap();
        }
        as_left[id].clone_from(&serial[id]);
    }
    assert_eq!(as_left, serial);

    let mut heir = worker(&server, 3, false).await;
    assert_eq!(roadmap::adopt(&index, &mut heir).await.unwrap(), 3);
    let roadmap = read(&index).await;
    assert!(!roadmap.pending.contains(&true));
    assert_eq!(stored(&roadmap), serial);
    assert_eq!(roadmap::adopt(&index, &mut heir).await.unwrap(), 0);
}

#[tokio::test]
async fn a_sparse_roadmap_has_no_two_milestones_too_near_to_each_other() {
    let server = Server::start();
    let index = server.index("roadmap", SPACE).await;
    let (first, second) = (
        worker(&server, 0, false).await,
        worker(&server, 1, true).await,
    );
    let sparse = [first, second.batch(5)].map(|worker| worker.min_separation(1.2));
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
