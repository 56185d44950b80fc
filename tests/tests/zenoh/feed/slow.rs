//! A subscriber that does not read its publications.

use std::sync::{Mutex, mpsc};

use prost::Message;
use serde_json::Value;
use wayfold_proto::v1::{self, ResetReason};
use wayfold_tests::{Stubs, figures::resident_bytes, number};

use super::{insertion, uid};
use crate::{
    follower::Follower,
    robot::{Robot, server_with},
};

/// A publication is dropped if its link has no room; the subscriber learns from the log that it is too late.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_subscriber_that_does_not_read_costs_no_memory_and_receives_a_reset() {
    const PAYLOAD: usize = 60_000;
    let settings = [("WAYFOLD_INDEX__WINDOW_BYTES", "1000000")];
    let (server, locator) = server_with(&[], &settings);
    let mut stubs = Stubs::connect(server.uri()).await;
    let uid = uid(stubs.create("arm", "R2").await);
    let slow = Robot::connect(&locator).await;
    // The link is shut until `open` is dropped.
    let (open, gate) = mpsc::channel::<()>();
    let gate = Mutex::new(gate);
    let (tell, mut received) = tokio::sync::mpsc::unbounded_channel();
    // Zenoh calls it on the thread that reads the link, and so reads no more.
    let events = slow
        .session
        .declare_subscriber("wayfold/v1/arm/events")
        .callback(move |sample| {
            let message = v1::WatchResponse::decode(&*sample.payload().to_bytes()).unwrap();
            let _ = tell.send(
                message
                    .mutations
                    .first()
                    .map(|first| number(&first.revision)),
            );
            let _ = gate.lock().unwrap().recv();
        });
    let events = events.await.unwrap();
    assert_eq!(received.recv().await, Some(None));

    let resident = || resident_bytes(server.process().id()).unwrap();
    stubs.insert(insertion(&[1], PAYLOAD)).await;
    let before = resident();
    const WRITES: u64 = 2_000;
    for write in 0..WRITES {
        let tags = vec![write + 10];
        let moved = v1::InsertRequest {
            tags,
            ..insertion(&[1], PAYLOAD)
        };
        stubs.insert(moved).await;
    }
    let grown = resident().saturating_sub(before);
    let published = WRITES * PAYLOAD as u64;
    assert!(grown < published / 2, "{grown} bytes of {published}");

    // Other peers are answered meanwhile.
    let robot = Robot::connect(&locator).await;
    let info = robot.json("arm/info", Value::Null).await.unwrap();
    assert_eq!(info["index"]["revision"]["number"], WRITES + 1);
    let follower = Follower::new(&robot, &uid);
    assert_eq!(follower.log().await.reset(), ResetReason::WindowPassed);

    drop(open);
    // Once it reads again, new publications come through, and show that some were dropped.
    let mut last = 0;
    for more in 2.. {
        if last > WRITES + 1 {
            break;
        }
        stubs.insert(insertion(&[more], 1)).await;
        while let Ok(revision) = received.try_recv() {
            last = last.max(revision.unwrap_or_default());
        }
    }
    events.undeclare().await.unwrap();
}
