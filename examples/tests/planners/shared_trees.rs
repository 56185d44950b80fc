//! Two trees that several workers grow together are trees, and each search found the nearest vertex of its revision, by
//! a comparison with brute force.

use std::{collections::BTreeSet, sync::LazyLock};

use wayfold::Neighbor;
use wayfold_examples::{
    maze::scene::Maze,
    planning::{
        error::PlanningError,
        options::Source as Form,
        path,
        problem::Problem,
        shared_trees::{
            nearest::Source,
            solve,
            store::{Layout, Store},
            trees::SharedTrees,
            vertex::{self, ROOTS},
            worker::{SearchRecord, Worker},
        },
    },
};

use crate::server::Server;

/// A goal some corners away from the start.
static MAZE: LazyLock<Maze> = LazyLock::new(|| Maze::between((0, 0), (2, 3)));
const SEED: u64 = 3;

/// The roots of both trees.
async fn planted(server: &Server, layout: Layout) -> Store {
    let client = server.client().await;
    Store::create(&client, "trees", layout, &*MAZE)
        .await
        .unwrap()
}

/// A worker with a connection of its own.
async fn worker(server: &Server, layout: Layout, number: usize) -> Worker<'static, Maze> {
    let client = server.client().await;
    let store = Store::open(&client, "trees", layout).await.unwrap();
    let kind = [Form::Shared, Form::Remote][number % 2];
    let source = Source::open(&client, &store, kind).await.unwrap();
    let worker = Worker::new(&*MAZE, store, source, number, SEED);
    worker.batch(1 + number / 2).remember()
}

/// Asserts that each node but the root was stored after its parent, or behind it in the same insert, and that an
/// independent check finds the motion between them free.
fn are_trees(shared: &SharedTrees) {
    for (tree, root) in [MAZE.start(), MAZE.goal()].into_iter().enumerate() {
        let (nodes, revisions) = (&shared.trees[tree], &shared.revisions[tree]);
        assert_eq!((nodes.parents[0], nodes.states.row(0)), (None, root));
        for node in 1..nodes.len() {
            let parent = nodes.parents[node].unwrap();
            let is_next = nodes.ids[node] == nodes.ids[parent] + 1;
            let is_later = revisions[parent] < revisions[node];
            assert!(is_later || is_next && revisions[parent] == revisions[node]);
            let edge = [parent, node].map(|end| nodes.states.row(end).to_vec());
            path::verify(&*MAZE, &edge).unwrap();
        }
    }
}

/// The vertex that a search had to find.
fn nearest(shared: &SharedTrees, asked: &SearchRecord) -> Option<Neighbor> {
    let (nodes, revisions) = (&shared.trees[asked.tree], &shared.revisions[asked.tree]);
    let there = (0..nodes.len()).filter(|&node| revisions[node] <= asked.revision);
    let measured = there.map(|node| Neighbor {
        distance: MAZE.space().distance(&asked.state, nodes.states.row(node)),
        id: nodes.ids[node],
    });
    measured.min()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn four_workers_grow_two_trees_by_nearest_vertices_until_they_meet() {
    grow(Layout::Indices).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn four_workers_grow_two_trees_in_one_index() {
    grow(Layout::Tags).await;
}

async fn grow(layout: Layout) {
    let server = Server::start();
    let store = planted(&server, layout).await;
    let mut tasks = Vec::new();
    for number in 0..4 {
        let mut worker = worker(&server, layout, number).await;
        // In any schedule, each worker has a part in the trees.
        worker.grow(1, |_| Ok(())).await.unwrap();
        tasks.push(worker);
    }
    let tasks = tasks.into_iter().map(|mut worker| {
        tokio::spawn(async move {
            let met = worker.grow(100_000, |_| Ok(())).await.unwrap();
            (met, worker.account(), worker.into_searches())
        })
    });
    let (mut asked, mut vertices) = (Vec::new(), 0);
    for task in tasks.collect::<Vec<_>>() {
        let (met, account, own) = task.await.unwrap();
        assert!(met, "all learn of it");
        assert!(own.len() as u64 > account.inserts);
        vertices += account.vertices;
        asked.extend(own);
    }

    let (shared, path) = solve::read(&store).await.unwrap();
    assert_eq!(shared.len() as u64, vertices + 2);
    let makers: BTreeSet<_> = shared.makers.iter().flatten().collect();
    assert_eq!(makers, BTreeSet::from([&0, &1, &2, &3]));
    are_trees(&shared);
    path::verify(&*MAZE, &path).unwrap();
    assert_eq!(path.first().unwrap(), MAZE.start());
    assert_eq!(path.last().unwrap(), MAZE.goal());
    for asked in &asked {
        assert_eq!(Some(asked.found), nearest(&shared, asked), "{asked:?}");
    }
    let in_between = |asked: &&SearchRecord| {
        let last = shared.revisions.iter().flatten().max();
        asked.revision > 1 && Some(&asked.revision) < last
    };
    assert!(asked.iter().filter(in_between).count() > 20);
}

#[tokio::test]
async fn the_first_announced_meeting_of_the_trees_counts() {
    let server = Server::start();
    let store = planted(&server, Layout::Indices).await;
    let meeting = store.meeting();
    assert_eq!(meeting.vertices().await.unwrap(), None);
    let unsolved = solve::read(&store).await;
    assert!(matches!(
        unsolved,
        Err(PlanningError::Unsolved { nodes: 2 })
    ));
    let listeners: Vec<_> = (0..3)
        .map(|_| tokio::spawn(meeting.clone().heard()))
        .collect();
    meeting.announce(MAZE.start(), [7, 8]).await.unwrap();
    meeting.announce(MAZE.goal(), [9, 10]).await.unwrap();
    for listener in listeners {
        listener.await.unwrap().unwrap();
    }
    assert_eq!(meeting.vertices().await.unwrap(), Some([7, 8]));
    // A late watcher receives it too.
    meeting.clone().heard().await.unwrap();
    // The announced vertices do not exist.
    let unread = solve::read(&store).await;
    assert!(matches!(unread, Err(PlanningError::Vertex { id: 7, .. })));
}

#[tokio::test]
async fn invalid_trees_are_not_read() {
    let server = Server::start();
    let store = planted(&server, Layout::Tags).await;
    let index = store.index(0);
    let refused = async |id: u64, tree: usize, payload: &[u8]| {
        let insert = index.insert([MAZE.start()]).ids([id]);
        let insert = insert.tags([vertex::tag(tree, 0)]);
        insert.payloads([payload.to_vec()]).await.unwrap();
        let read = SharedTrees::read(&store).await;
        index.remove([id]).await.unwrap();
        matches!(read, Err(PlanningError::Vertex { id: named, .. }) if named == id)
    };
    assert!(refused(20, 0, &[]).await, "no parent");
    assert!(refused(20, 0, &[1, 2, 3]).await, "no id");
    assert!(refused(20, 0, &vertex::payload(99)).await, "no such vertex");
    assert!(refused(20, 0, &vertex::payload(20)).await, "its own parent");
    let other = vertex::payload(ROOTS[1]);
    assert!(refused(20, 0, &other).await, "of the other tree");
    assert!(!refused(20, 1, &other).await, "of its own tree");
    assert_eq!(SharedTrees::read(&store).await.unwrap().len(), 2);
}
