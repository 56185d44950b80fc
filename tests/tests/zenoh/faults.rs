//! Servers and routers are killed and restarted: clients go on querying and following, and no answer is wrong.

use serde_json::json;
use wayfold_proto::v1;
use wayfold_tests::{Content, Signal, Stubs};
use zenoh::{
    bytes::Encoding,
    handlers::FifoChannelHandler,
    pubsub::Subscriber,
    sample::{Sample, SampleKind},
};

use crate::{
    feed::{self, catch_up, insertion, next, subscribe},
    follower::Follower,
    robot::{Robot, router, server_at, server_behind, server_with},
};

type Tokens = Subscriber<FifoChannelHandler<Sample>>;

async fn tokens(robot: &Robot) -> Tokens {
    let liveliness = robot.session.liveliness();
    let tokens = liveliness.declare_subscriber("wayfold/v1/arm/@alive");
    tokens.history(true).await.unwrap()
}

/// Waits until the index is served, or until it is no longer served.
async fn until(tokens: &Tokens, kind: SampleKind) {
    while tokens.recv_async().await.unwrap().kind() != kind {}
}

async fn compare(follower: &Follower<'_>, stubs: &Stubs) {
    let content = Content::read(stubs, "arm").await.unwrap();
    assert_eq!(follower.content, content);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_is_killed_and_comes_back_is_found_again_with_its_past() {
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().join("data");
    let data = ["--data", data.to_str().unwrap()];
    let (mut server, locator) = server_with(&data, &[]);
    let mut stubs = Stubs::connect(server.uri()).await;
    let uid = feed::uid(stubs.create("arm", "R2").await);
    let robot = Robot::connect(&locator).await;
    let tokens = tokens(&robot).await;
    until(&tokens, SampleKind::Put).await;
    let events = subscribe(&robot).await;
    let mut follower = Follower::new(&robot, &uid);
    for round in 1..4 {
        catch_up(&mut follower, &events, &mut stubs).await;
        compare(&follower, &stubs).await;
        // The kill falls into the middle of a batch or of its publication.
        let request = v1::InsertRequest {
            tags: vec![round; 400],
            ..insertion(&(1_000..1_400).collect::<Vec<_>>(), 500)
        };
        let mut writer = stubs.clone();
        let writing = tokio::spawn(async move { writer.points.insert(request).await });
        stubs.insert(insertion(&[round], 20)).await;
        next(&events).await;
        server.stop(Signal::Kill);
        // The mutation may have been stored or not; either is right.
        let _ = writing.await.unwrap();
        until(&tokens, SampleKind::Delete).await;

        server = server_at(&locator, &data, &[]).0;
        until(&tokens, SampleKind::Put).await;
        stubs = Stubs::connect(server.uri()).await;
        assert_eq!(feed::uid(stubs.describe("arm").await), uid);
    }
    catch_up(&mut follower, &events, &mut stubs).await;
    compare(&follower, &stubs).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_router_that_is_killed_and_comes_back_is_no_loss() {
    let (mut router_process, at) = router("tcp/127.0.0.1:0");
    let server = server_behind(&at, &[], &[]);
    let mut stubs = Stubs::connect(server.uri()).await;
    let uid = feed::uid(stubs.create("arm", "R2").await);
    let robot = Robot::connect(&at).await;
    let tokens = tokens(&robot).await;
    until(&tokens, SampleKind::Put).await;
    let events = subscribe(&robot).await;
    let mut follower = Follower::new(&robot, &uid);
    for round in 1..4 {
        catch_up(&mut follower, &events, &mut stubs).await;
        compare(&follower, &stubs).await;
        // The insert may never be answered; then a retry takes effect once.
        let operation = format!("operation-{round}");
        let request =
            json!({ "states": [[round, 7]], "ids": [70 + round], "operation_id": operation });
        let insert = async || {
            let payload = request.to_string().into_bytes();
            let key = "wayfold/v1/arm/insert";
            robot.all(key, payload, Encoding::APPLICATION_JSON).await
        };
        let (first, ()) = tokio::join!(insert(), async {
            router_process.stop(Signal::Kill);
        });
        until(&tokens, SampleKind::Delete).await;
        let (restarted, place) = router(&at);
        assert_eq!(place, at);
        router_process = restarted;
        until(&tokens, SampleKind::Put).await;
        let again = insert().await.remove(0).unwrap().json();
        assert_eq!(again["outcomes"], json!(["INSERTED"]));
        // Any other reply is Zenoh's error that there will be no answer.
        for reply in first.into_iter().flatten() {
            assert_eq!(reply.json(), again);
        }
    }
    catch_up(&mut follower, &events, &mut stubs).await;
    compare(&follower, &stubs).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_log_tells_whether_a_router_is_reached() {
    let (first, at) = router("tcp/127.0.0.1:0");
    first.stop(Signal::Kill);
    let retry = json!({ "period_init_ms": 20, "period_max_ms": 100 });
    let peer = json!({ "connect": { "endpoints": [at], "retry": retry } }).to_string();
    let settings = [("WAYFOLD_ZENOH__CONFIG", &*peer)];
    let (mut server, _) = server_with(&[], &settings);
    server.log_until("no Zenoh router or peer is reached yet");
    for _ in 0..2 {
        let (reached, _) = router(&at);
        server.log_until("a Zenoh router or peer is reached");
        reached.stop(Signal::Kill);
        server.log_until("the last link to a Zenoh router or peer is gone");
    }
}
