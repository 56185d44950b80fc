//! Outages of a shared index over Zenoh: a silent server, a passed window, an index that is deleted or made again.

use std::time::Duration;

use wayfold::{Code, ConnectionStatus, Error, ResetReason, Search, WatchEvent};
use wayfold_index::Space;
use wayfold_tests::{Signal, States};

use super::{
    checks::{check_silence, wait_for_status},
    history::{check_copies, content, wait_for_all},
    open, shared,
};
use crate::robot::{Robot, router, server, server_behind};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_copy_that_missed_more_than_the_server_keeps_reads_all_again() {
    let space: Space = "R2".parse().unwrap();
    let (mut router_process, at) = router("tcp/127.0.0.1:0");
    let server = server_behind(&at, &[], &[("WAYFOLD_INDEX__WINDOW_BYTES", "1000")]);
    let robot = Robot::connect(&at).await;
    let away = shared(&robot, &space);
    let there = wayfold::Index::shared(server.uri(), "arm").open().unwrap();
    let client = wayfold::Client::connect(server.uri()).await.unwrap();
    let index = client.index("arm").await.unwrap();
    let mut states = States::new(space.clone(), 5);
    for _ in 0..2 {
        wait_for_all(&there, &[1e6, 1e6], &[&away]);
        let reached = index.info().await.unwrap().revision;
        let before = away.search([0.0; 2], &Search::k(1)).unwrap().read_revision;
        router_process.stop(Signal::Kill);
        for _ in 0..40 {
            there.insert_many(states.rows(50).chunks(2)).unwrap();
            there.flush().unwrap();
        }
        let pending = away.insert(&states.row()[..]).unwrap();
        let mut watch = index.watch().after(reached).await.unwrap();
        let Ok(Some(WatchEvent::Reset(reset))) = watch.next().await else {
            panic!("the window is wider than thought")
        };
        assert_eq!(reset.reason, ResetReason::WindowPassed);
        router_process = router(&at).0;
        away.flush().unwrap();
        wait_for_all(&there, &[1e6, 1e6], &[&away, &there]);
        assert!(there.get(pending).unwrap().is_some());
        check_copies(&content(&shared(&robot, &space)), &space, &[&away, &there]);
        assert_eq!(away.changes(before).unwrap(), None);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_deleted_index_and_one_of_another_space_end_the_copy() {
    let (server, locator) = server();
    let client = wayfold::Client::connect(server.uri()).await.unwrap();
    let robot = Robot::connect(&locator).await;
    let copy = shared(&robot, &"R2".parse().unwrap());
    client.delete_index("arm").await.unwrap();
    wait_for_status(&copy, |status| match status {
        ConnectionStatus::Ended { why } => why.code() == Code::NotFound,
        _ => false,
    });
    assert!(matches!(copy.insert([1.0, 2.0]), Err(Error::Ended { .. })));

    let copy = shared(&robot, &"R2".parse().unwrap());
    client.delete_index("arm").await.unwrap();
    let line = "R1".parse().unwrap();
    client.create_index("arm", &line).await.unwrap();
    wait_for_status(&copy, |status| match status {
        ConnectionStatus::Ended { why } => matches!(**why, Error::OtherSpace { .. }),
        _ => false,
    });
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pending_writes_are_bounded_while_the_server_is_silent() {
    let (server, locator) = server();
    let robot = Robot::connect(&locator).await;
    let index = open(&robot.session, "wayfold/v1");
    let open = || shared(&robot, &"R2".parse().unwrap());
    check_silence(&server, index, Duration::from_secs(1), open);
}
