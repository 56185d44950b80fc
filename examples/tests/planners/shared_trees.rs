//! Two trees that several workers grow together are trees, and each search found the nearest vertex of a revision and
//! of the worker's own before it, by a comparison with brute force.

use std::{collections::BTreeSet, sync::LazyLock, thread};

use wayfold::Neighbor;
use wayfold_examples::{
    maze::scene::Maze,
    planning::{
        error::PlanningError,
        options::Source,
        path,
        problem::Problem,
        shared_trees::{
            meeting::{self, Meeting},
            solve,
            store::Store,
            trees::SharedTrees,
            vertex::ROOTS,
            worker::{SearchRecord, Worker},
        },
    },
};

use crate::server::Server;

/// A goal some corners away from the start.
static MAZE: LazyLock<Maze> = LazyLock::new(|| Maze::between((0, 0), (2, 3)));
const SEED: u64 = 3;

/// The roots of both trees.
async fn planted(server: &Server) -> Store {
    let client = server.client().await;
    Store::create(&client, "trees", &*MAZE).await.unwrap()
}

/// A worker with connections of its own.
fn worker(server: &Server, number: usize) -> Worker<'static, Maze> {
    let source = [Source::Shared, Source::Remote][number / 3];
    let worker = Worker::open(&*MAZE, (&server.uri, "trees"), source, number, SEED);
    worker.unwrap().remember()
}

/// Asserts that each node but the root was stored after its parent, or behind it in the same mutation, and that an
/// independent check finds the motion between them free.
fn are_trees(shared: &SharedTrees) {
    for (tree, root) in [MAZE.start(), MAZE.goal()].into_iter().enumerate() {
        let (nodes, revisions) = (&shared.trees[tree], &shared.revisions[tree]);
        assert_eq!((nodes.parents[0], nodes.states.row(0)), (None, root));
        for node in 1..nodes.len() {
            let parent = nodes.parents[node].unwrap();
            let [of_parent, of_node] =
                [parent, node].map(|node| (revisions[node], nodes.ids[node]));
            assert!(of_parent < of_node);
            let makers = &shared.makers[tree];
            assert!(of_parent.0 < of_node.0 || makers[parent] == makers[node]);
            let edge = [parent, node].map(|end| nodes.states.row(end).to_vec());
            path::verify(&*MAZE, &edge).unwrap();
        }
    }
}

/// Asserts that each search of a worker found the nearest vertex among its own before it and those of the others up to
/// some revision, which never goes back. Returns these revisions where they are known: where the vertex is another's.
fn are_nearest(shared: &SharedTrees, worker: usize, searches: &[SearchRecord]) -> Vec<u64> {
    let (mut read, mut known) = ([0, 0], Vec::new());
    for search in searches {
        let (nodes, tree) = (&shared.trees[search.tree], search.tree);
        let (revisions, makers) = (&shared.revisions[tree], &shared.makers[tree]);
        let is_own = |node: usize| makers[node] == worker && nodes.ids[node] != ROOTS[tree];
        let found = nodes.node(search.found.id).unwrap();
        if !is_own(found) {
            read[tree] = revisions[found].max(read[tree]);
            known.push(read[tree]);
        }
        // A worker's own vertices have ascending ids and stand in that order.
        let mut own = 0;
        let seen = (0..nodes.len()).filter(|&node| match is_own(node) {
            true => {
                own += 1;
                own <= search.own
            }
            false => revisions[node] <= read[tree],
        });
        let measured = seen.map(|node| Neighbor {
            distance: MAZE.space().distance(&search.state, nodes.states.row(node)),
            id: nodes.ids[node],
        });
        assert_eq!(Some(search.found), measured.min(), "{search:?}");
    }
    known
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn four_workers_grow_two_trees_by_nearest_vertices_until_they_meet() {
    let server = Server::start();
    let store = planted(&server).await;
    let mut workers: Vec<_> = (0..4).map(|number| worker(&server, number)).collect();
    for worker in &mut workers {
        // In any schedule, each worker has a part in the trees.
        worker.grow(1, |_| Ok(())).unwrap();
    }
    let threads = workers.into_iter().map(|mut worker| {
        thread::spawn(move || {
            let met = worker.grow(100_000, |_| Ok(())).unwrap();
            assert!(met, "all learn of it");
            (worker.account(), worker.into_searches())
        })
    });
    let threads: Vec<_> = threads.collect();
    let grown: Vec<_> = threads
        .into_iter()
        .map(|thread| thread.join().unwrap())
        .collect();
    let vertices: u64 = grown.iter().map(|(account, _)| account.vertices).sum();

    let (shared, path) = solve::read(&store).await.unwrap();
    assert_eq!(shared.len() as u64, vertices + 2);
    let makers: BTreeSet<_> = shared.makers.iter().flatten().collect();
    assert_eq!(makers, BTreeSet::from([&0, &1, &2, &3]));
    are_trees(&shared);
    path::verify(&*MAZE, &path).unwrap();
    assert_eq!(path.first().unwrap(), MAZE.start());
    assert_eq!(path.last().unwrap(), MAZE.goal());
    let last = shared.revisions.iter().flatten().max().unwrap();
    let mut in_between = 0;
    for (worker, (account, searches)) in grown.iter().enumerate() {
        assert!(searches.len() as u64 > account.samples);
        let known = are_nearest(&shared, worker, searches);
        in_between += known.iter().filter(|&at| at > &1 && at < last).count();
    }
    assert!(in_between > 20);
}

#[tokio::test]
async fn the_first_announced_meeting_of_the_trees_counts() {
    let server = Server::start();
    let store = planted(&server).await;
    assert_eq!(meeting::vertices(store.meeting()).await.unwrap(), None);
    let unsolved = solve::read(&store).await;
    assert!(matches!(
        unsolved,
        Err(PlanningError::Unsolved { nodes: 2 })
    ));
    let meeting = || Meeting::open(&server.uri, "trees", MAZE.space()).unwrap();
    let listeners: Vec<_> = (0..3).map(|_| meeting()).collect();
    assert!(!listeners[2].has_happened().unwrap());
    listeners[0].announce(MAZE.start(), [7, 8]).unwrap();
    listeners[1].announce(MAZE.goal(), [9, 10]).unwrap();
    for listener in &listeners {
        while !listener.has_happened().unwrap() {
            thread::yield_now();
        }
    }
    let vertices = meeting::vertices(store.meeting()).await.unwrap();
    assert_eq!(vertices, Some([7, 8]));
    // A late worker learns of it too.
    assert!(meeting().has_happened().unwrap());
    // The announced vertices do not exist.
    let unread = solve::read(&store).await;
    assert!(matches!(unread, Err(PlanningError::Vertex { id: 7, .. })));
}

#[tokio::test]
async fn invalid_trees_are_not_read() {
    let server = Server::start();
    let store = planted(&server).await;
    let refused = async |id: u64, tree: usize, payload: &[u8]| {
        let index = &store.indices()[tree];
        let insert = index.insert([MAZE.start()]).ids([id]);
        insert.payloads([payload.to_vec()]).await.unwrap();
        let read = SharedTrees::read(&store).await;
        index.remove([id]).await.unwrap();
        matches!(read, Err(PlanningError::Vertex { id: named, .. }) if named == id)
    };
    assert!(refused(20, 0, &[]).await, "no parent");
    assert!(refused(20, 0, &[1, 2, 3]).await, "no id");
    assert!(refused(ROOTS[1], 0, &[]).await, "the root of the other");
    assert!(
        refused(20, 0, &99_u64.to_le_bytes()).await,
        "no such vertex"
    );
    assert!(
        refused(20, 0, &20_u64.to_le_bytes()).await,
        "its own parent"
    );
    // The tree from the start is read first, so only its vertices could be taken for parents in the other one.
    let start = ROOTS[0].to_le_bytes();
    assert!(refused(20, 1, &start).await, "of the other tree");
    assert!(!refused(20, 0, &start).await, "of its own tree");
    assert_eq!(SharedTrees::read(&store).await.unwrap().len(), 2);
}
