//! The order of a stop, and the count of dropped messages.

use std::{
    sync::{Mutex, mpsc},
    time::Duration,
};

use tokio::sync::oneshot;
use zenoh::{Config, Wait, qos::CongestionControl};

use super::*;
use crate::{observe::Metrics, service::Service};

/// The refusal of a query.
async fn refusal(robot: &Session) -> String {
    let query = robot.get("wayfold/v1/list");
    let replies = query.timeout(Duration::from_secs(60)).await.unwrap();
    let reply = replies.recv_async().await.unwrap();
    let refusal = reply.into_result().unwrap_err();
    String::from_utf8(refusal.payload().to_bytes().into_owned()).unwrap()
}

/// A face, a client that is linked with it, and the metrics of the face.
async fn face_and_robot() -> (ZenohFace, Session, Metrics) {
    let mut settings = crate::config::Config::default();
    settings.zenoh.listen = "tcp/127.0.0.1:0".into();
    let service = Service::starting(Default::default());
    let shared = Shared::new(&settings, service, Default::default());
    let metrics = shared.metrics.clone();
    let face = ZenohFace::open(&settings.zenoh, shared, false)
        .await
        .unwrap();
    let face = face.unwrap();
    let config = format!(
        "{{ mode: 'client', connect: {{ endpoints: ['{}'] }}, scouting: {{ multicast: {{ enabled: false }} }} }}",
        face.locators().await[0]
    );
    let robot = zenoh::open(Config::from_json5(&config).unwrap());
    (face, robot.await.unwrap(), metrics)
}

/// The links stay open for a moment after the last answer, and the queryable with them: it refuses a client that asks
/// then. Without the queryable the client would get no reply.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_that_asks_while_the_links_are_still_open_is_refused() {
    let (face, robot, _) = face_and_robot().await;
    let refused = refusal(&robot).await;
    assert!(refused.contains("STARTING"), "{refused}");

    let (lingers, lingering) = oneshot::channel();
    let (leave, left) = oneshot::channel();
    let stopped = tokio::spawn(face.stop_after(async {
        lingers.send(()).unwrap();
        left.await.unwrap();
    }));
    // By now no query is under way.
    lingering.await.unwrap();
    let refused = refusal(&robot).await;
    assert!(refused.contains("STOPPING"), "{refused}");
    leave.send(()).unwrap();
    stopped.await.unwrap();
    robot.close().await.unwrap();
}

fn dropped(metrics: &Metrics) -> u64 {
    let text = metrics.text().unwrap();
    let mut lines = text.lines();
    let count = lines.find_map(|line| line.strip_prefix("wayfold_zenoh_dropped_total "));
    count.unwrap().parse().unwrap()
}

/// A message that finds its link full is counted, also after the link is closed.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_to_a_subscriber_that_does_not_read_are_counted_as_dropped() {
    const KEY: &str = "wayfold/v1/arm/events";
    let (face, robot, metrics) = face_and_robot().await;
    let publisher = face.session.declare_publisher(KEY);
    let publisher = publisher.congestion_control(CongestionControl::Drop);
    let publisher = Arc::new(publisher.await.unwrap());
    // Zenoh calls it on the thread that reads the link, and so reads no more until `open` is dropped.
    let (open, gate) = mpsc::channel::<()>();
    let gate = Mutex::new(gate);
    let (tell, mut received) = tokio::sync::mpsc::unbounded_channel();
    let slow = robot.declare_subscriber(KEY).callback(move |_| {
        let _ = tell.send(());
        let _ = gate.lock().unwrap().recv();
    });
    let slow = slow.await.unwrap();
    let put = || {
        let publisher = Arc::clone(&publisher);
        let put = move || publisher.put(vec![0; 60_000]).wait().unwrap();
        tokio::task::spawn_blocking(put)
    };
    let dropping = async {
        // The subscription has reached the face once a message arrives.
        while received.is_empty() {
            put().await.unwrap();
        }
        received.recv().await.unwrap();
        assert_eq!(dropped(&metrics), 0);
        while dropped(&metrics) < 2 {
            put().await.unwrap();
        }
    };
    let dropping = tokio::time::timeout(Duration::from_secs(60), dropping);
    dropping.await.expect("Zenoh drops messages");
    let count = dropped(&metrics);
    drop(open);
    slow.undeclare().await.unwrap();
    robot.close().await.unwrap();
    assert!(dropped(&metrics) >= count);
    drop(publisher);
    face.stop().await;
}
