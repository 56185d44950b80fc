//! The examples run, and return correct results.

#![expect(dead_code, reason = "the tests call what each `main` calls")]

#[path = "../../examples/hello.rs"]
mod hello;
#[path = "../../examples/rrt.rs"]
mod rrt;
#[path = "../../examples/shared_prm.rs"]
mod shared_prm;
#[path = "../../examples/watch.rs"]
mod watch;

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

#[tokio::test]
async fn watch_is_told_of_every_mutation() {
    let server = Server::start();
    assert_eq!(watch::watch(&server.uri).await.unwrap(), [1, 4]);
}
