//! A replica that receives mutations over Zenoh answers like brute force, despite failures of the server and of the
//! router between them.

#[path = "../e2e/replica/history.rs"]
mod history;
#[path = "../e2e/shared/proxy.rs"]
#[expect(dead_code, reason = "the suite over gRPC cuts connections too")]
mod proxy;

use std::sync::{
    Arc,
    atomic::{AtomicBool, Ordering},
};

use serde_json::json;
use wayfold::{Client, Replica, ResetReason, WatchEvent};
use wayfold_index::{Linear, Space};
use wayfold_tests::{Process, ServerProcess, Signal, States, brute_force};

use crate::robot::{Robot, server_with};
use history::{History, ReplicaAnswer, client, compare};
use proxy::Proxy;

const SPACE: &str = "R2*SO2*SO3:0.15";

/// A router at a locator.
fn router(at: &str) -> (Process, String) {
    let mut router = Process::start(env!("CARGO_BIN_EXE_router-process"), &[at]);
    let at = router.line().unwrap();
    (router, at)
}

/// A server whose only Zenoh link is to the router at `at`.
fn server_behind(at: &str, data: &[&str], setting: (&str, &str)) -> ServerProcess {
    let retry = json!({ "period_init_ms": 20, "period_max_ms": 100 });
    let behind = json!({ "mode": "client", "connect": { "endpoints": [at], "retry": retry } });
    let behind = behind.to_string();
    server_with(data, &[("WAYFOLD_ZENOH__CONFIG", &behind), setting]).0
}

async fn replica(client: &Client, robot: &Robot) -> Replica {
    let request = client
        .replica("arm")
        .over_zenoh(robot.session.clone(), "wayfold/v1");
    request.await.unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_answer_is_brute_forces_through_kills_of_server_and_router() {
    const CALLS: u64 = 150;
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().join("data");
    let data = ["--data", data.to_str().unwrap()];
    let (mut router_process, at) = router("tcp/127.0.0.1:0");
    let start = || server_behind(&at, &data, ("WAYFOLD_INDEX__GROWING_ROWS", "32"));
    let mut server = start();
    let way = Proxy::to(server.uri()).await;
    let space: Space = SPACE.parse().unwrap();
    let client = client(&way.uri).await;
    let index = client.create_index("arm", &space).await.unwrap();
    let robot = Robot::connect(&at).await;
    let replica = replica(&client, &robot).await;

    let stop = Arc::new(AtomicBool::new(false));
    let readers = [0, 1].map(|seed| {
        let (replica, space, stop) = (replica.clone(), space.clone(), stop.clone());
        std::thread::spawn(move || history::ask(&replica, space, seed, &stop))
    });
    let writers = [1, 2].map(|name| tokio::spawn(history::write(index.clone(), name, CALLS)));
    for revision in (25..2 * CALLS).step_by(25) {
        replica
            .at_least(&index.revision_at(revision))
            .await
            .unwrap();
        match revision % 75 {
            25 => {
                router_process.stop(Signal::Kill);
                router_process = router(&at).0;
            }
            50 => {
                server.stop(Signal::Kill);
                server = start();
                way.lead_to(server.uri());
            }
            _ => {}
        }
    }
    let mut past = History::new();
    for writer in writers {
        past.extend(writer.await.unwrap());
    }
    replica
        .at_least(&index.revision_at(2 * CALLS))
        .await
        .unwrap();
    stop.store(true, Ordering::Relaxed);
    let answers = readers
        .into_iter()
        .flat_map(|reader| reader.join().unwrap());
    let answers: Vec<ReplicaAnswer> = answers.collect();
    println!("{} answers", answers.len());
    let points = history::check(&space, &past, answers);
    compare(&replica, &points);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_index_whose_records_are_trimmed_is_read_anew() {
    let (mut router_process, at) = router("tcp/127.0.0.1:0");
    let server = server_behind(&at, &[], ("WAYFOLD_INDEX__WINDOW_BYTES", "1000"));
    let client = client(server.uri()).await;
    let space: Space = SPACE.parse().unwrap();
    let index = client.create_index("arm", &space).await.unwrap();
    let robot = Robot::connect(&at).await;
    let replica = replica(&client, &robot).await;
    let mut states = States::new(space.clone(), 5);
    let mut points = Linear::new(space.clone());
    for round in 0..3 {
        router_process.stop(Signal::Kill);
        for _ in 0..20 {
            let rows = states.rows(20);
            let first = points.len() as u64;
            let ids: Vec<u64> = (first..first + 20).collect();
            let insert = index.insert(rows.chunks(space.coordinates()));
            let revision = insert.ids(ids.clone()).await.unwrap().revision.number;
            brute_force::store(&mut points, &ids, &rows, 0, revision);
        }
        let newest = index.info().await.unwrap().revision;
        let stopped_at = replica.revision();
        assert!(stopped_at.number < newest.number, "in round {round}");
        let mut watch = index.watch().after(stopped_at).await.unwrap();
        let Ok(Some(WatchEvent::Reset(reset))) = watch.next().await else {
            panic!("the window is wider than thought")
        };
        assert_eq!(reset.reason, ResetReason::WindowPassed);
        router_process = router(&at).0;
        replica.at_least(&newest).await.unwrap();
        compare(&replica, &points);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_index_made_anew_is_noticed_by_its_uid() {
    let (server, locator) = server_with(&[], &[]);
    let client = client(server.uri()).await;
    let line = client
        .create_index("arm", &"R1".parse().unwrap())
        .await
        .unwrap();
    line.insert([[0.0], [1.0]]).await.unwrap();
    let robot = Robot::connect(&locator).await;
    let replica = replica(&client, &robot).await;
    assert_eq!(replica.knn([0.9], 1).unwrap().nearest().unwrap().id, 1);
    for round in 0..5 {
        client.delete_index("arm").await.unwrap();
        let plane = client
            .create_index("arm", &"R2".parse().unwrap())
            .await
            .unwrap();
        let inserted = plane.insert([[5.0, f64::from(round)]]).await.unwrap();
        replica
            .status_where(|_| replica.index().uid() == plane.uid())
            .await;
        replica.at_least(&inserted.revision).await.unwrap();
        let found = replica.knn([5.0, 0.0], 1).unwrap();
        assert_eq!(
            (&*found.revision().uid, found.nearest().unwrap().distance),
            (plane.uid(), f64::from(round))
        );
    }
    let made = replica.write(replica.index().insert([[1.0, 0.0]]));
    let made = made.await.unwrap();
    let found = replica.knn([0.0, 0.0], 1).unwrap();
    assert!(found.revision().number >= made.revision.number);
    assert_eq!(found.nearest().unwrap().distance, 1.0);
}
