//! The examples run, and return correct results.

#![expect(dead_code, reason = "the tests call what each `main` calls")]

#[path = "../../examples/hello.rs"]
mod hello;
#[path = "../../examples/rrt.rs"]
mod rrt;
#[path = "../../examples/shared.rs"]
mod shared;
#[path = "../../examples/shared_prm.rs"]
mod shared_prm;
#[path = "../../examples/watch.rs"]
mod watch;

use std::thread;

use wayfold::Index;

use crate::server::Server;

#[tokio::test]
async fn hello_finds_the_docks_around_the_robot_each_time() {
    let server = Server::start();
    for _ in 0..2 {
        assert_eq!(hello::hello(&server.uri).await.unwrap(), [3, 1]);
    }
}

#[tokio::test]
async fn rrt_finds_a_way_around_the_discs() {
    let server = Server::start();
    let path = rrt::rrt(&server.uri, 2).await.unwrap();
    assert_eq!((path[0], path[path.len() - 1]), ([1.0, 1.0], [9.0, 9.0]));
    for way in path.windows(2) {
        assert!((way[0][0] - way[1][0]).hypot(way[0][1] - way[1][1]) < 0.501);
        // By other arithmetic: the point of the segment that is nearest to each center.
        for (center, radius) in [([3.0, 3.0], 1.5), ([7.5, 4.5], 2.0), ([4.0, 7.5], 2.0)] {
            assert!(to_segment(center, way[0], way[1]) > radius - 0.001);
        }
    }
    assert!(
        server
            .client()
            .await
            .list_indexes()
            .await
            .unwrap()
            .indexes
            .is_empty()
    );
}

/// The distance of a point from a segment.
fn to_segment(point: [f64; 2], a: [f64; 2], b: [f64; 2]) -> f64 {
    let along = [b[0] - a[0], b[1] - a[1]];
    let to = [point[0] - a[0], point[1] - a[1]];
    let length_2 = along[0].powi(2) + along[1].powi(2);
    let share = ((to[0] * along[0] + to[1] * along[1]) / length_2).clamp(0.0, 1.0);
    (to[0] - share * along[0]).hypot(to[1] - share * along[1])
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn workers_of_shared_prm_connect_all_milestones() {
    let server = Server::start();
    let roadmap = shared_prm::shared_prm(&server.uri).await.unwrap();
    // The server assigns ids in the order of the inserts, across all workers.
    assert!(roadmap.keys().copied().eq(0..400));
    let mut reached = vec![false; 400];
    let mut open = vec![0];
    while let Some(milestone) = open.pop() {
        if std::mem::replace(&mut reached[milestone as usize], true) {
            continue;
        }
        open.extend(&roadmap[&milestone]);
        let later = roadmap
            .iter()
            .filter(|(_, edges)| edges.contains(&milestone));
        open.extend(later.map(|(&later, _)| later));
    }
    assert!(reached.iter().all(|reached| *reached));
}

/// If two milestones are within the radius of each other, the later one has an edge to the earlier one.
#[test]
fn processes_of_shared_miss_no_edge_and_find_none_twice() {
    let server = Server::start();
    let work = &|seed| shared::shared(&server.uri, seed).map_err(|error| error.to_string());
    let parts = thread::scope(|scope| {
        let workers = [1, 2].map(|seed| scope.spawn(move || work(seed)));
        workers.map(|worker| worker.join().unwrap().unwrap())
    });
    let pair = |a: u64, b: u64| [a.min(b), a.max(b)];
    let mut edges = Vec::new();
    for (id, earlier) in parts.iter().flatten() {
        edges.extend(earlier.iter().map(|earlier| pair(*id, *earlier)));
    }
    edges.sort_unstable();

    let index = Index::shared(&server.uri, "roadmap").open().unwrap();
    let points: Result<Vec<_>, _> = index.scan().unwrap().collect();
    let points = points.unwrap();
    assert_eq!(points.len(), 400);
    let is_near = |a: &[f64], b: &[f64]| (a[0] - b[0]).hypot(a[1] - b[1]) <= 1.0;
    let mut expected = Vec::new();
    for (i, a) in points.iter().enumerate() {
        let near = points[..i].iter().filter(|b| is_near(&a.state, &b.state));
        expected.extend(near.map(|b| pair(a.id, b.id)));
    }
    expected.sort_unstable();
    assert_eq!(edges, expected);
}

#[tokio::test]
async fn watch_is_told_of_every_mutation() {
    let server = Server::start();
    assert_eq!(watch::watch(&server.uri).await.unwrap(), [1, 4]);
}
