//! The order of a stop.

use tokio::sync::oneshot;
use zenoh::Config;

use super::*;
use crate::service::Service;

/// The refusal of a query.
async fn refusal(robot: &Session) -> String {
    let query = robot.get("wayfold/v1/list");
    let replies = query.timeout(Duration::from_secs(60)).await.unwrap();
    let reply = replies.recv_async().await.unwrap();
    let refusal = reply.into_result().unwrap_err();
    String::from_utf8(refusal.payload().to_bytes().into_owned()).unwrap()
}

/// The links stay open for a moment after the last answer, and the queryable with them: it refuses a client that asks
/// then. Without the queryable the client would get no reply.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_that_asks_while_the_links_are_still_open_is_refused() {
    let mut settings = crate::config::Config::default();
    settings.zenoh.listen = "tcp/127.0.0.1:0".into();
    let service = Service::starting(Default::default());
    let shared = Shared::new(&settings, service, Default::default());
    let face = ZenohFace::open(&settings.zenoh, shared, false)
        .await
        .unwrap();
    let face = face.unwrap();
    let config = format!(
        "{{ mode: 'client', connect: {{ endpoints: ['{}'] }}, scouting: {{ multicast: {{ enabled: false }} }} }}",
        face.locators().await[0]
    );
    let robot = zenoh::open(Config::from_json5(&config).unwrap());
    let robot = robot.await.unwrap();
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
