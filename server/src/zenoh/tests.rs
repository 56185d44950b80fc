//! The order of a stop, the count of dropped messages, the check of tokens, and the places and waits of calls.

mod offers;
mod refusals;
mod strangers;

use std::{
    fs,
    pin::pin,
    sync::{Mutex, mpsc},
    time::Duration,
};

use futures_util::{StreamExt, stream::FuturesUnordered};
use sha2::{Digest, Sha256};
use tokio::{net::TcpStream, sync::oneshot, time::timeout};
use zenoh::{Config, Wait, bytes::Encoding, qos::CongestionControl, query::ReplyError};

use super::*;
use crate::{
    admission::CallTurns,
    identity::Identities,
    log::MemoryLog,
    observe::Metrics,
    service::Service,
    testing::{arm, log_with, server},
    verbs::Verb,
};

/// The first reply to a query.
async fn ask(
    robot: &Session,
    key: &str,
    attachment: Option<&str>,
) -> Result<zenoh::sample::Sample, ReplyError> {
    let query = robot.get(key).attachment(attachment.map(str::to_owned));
    let replies = query.timeout(Duration::from_secs(60)).await.unwrap();
    replies.recv_async().await.unwrap().into_result()
}

/// The texts of a refusal, in JSON or within Protocol Buffers.
fn text(refusal: &ReplyError) -> String {
    String::from_utf8_lossy(&refusal.payload().to_bytes()).into_owned()
}

/// The refusal of a query.
async fn refusal(robot: &Session) -> String {
    text(&ask(robot, "wayfold/v1/list", None).await.unwrap_err())
}

/// A face, a client that is linked with it, and the metrics of the face.
async fn face_and_robot(service: Service, identities: Identities) -> (ZenohFace, Session, Metrics) {
    face_and_robot_with(Default::default(), service, identities).await
}

async fn face_and_robot_with(
    mut settings: crate::config::Config,
    service: Service,
    identities: Identities,
) -> (ZenohFace, Session, Metrics) {
    settings.zenoh.listen = "tcp/127.0.0.1:0".into();
    let shared = FaceContext::new(&settings, service, identities);
    let metrics = shared.metrics.clone();
    let face = ZenohFace::open(&settings.zenoh, shared, false)
        .await
        .unwrap();
    let face = face.unwrap();
    let robot = robot(&face).await;
    (face, robot, metrics)
}

/// A client that is linked with a face.
async fn robot(face: &ZenohFace) -> Session {
    client(&face.locators().await[0]).await
}

async fn client(locator: &str) -> Session {
    let config = format!(
        "{{ mode: 'client', connect: {{ endpoints: ['{locator}'] }}, scouting: {{ multicast: {{ enabled: false }} }} }}"
    );
    let robot = zenoh::open(Config::from_json5(&config).unwrap());
    robot.await.unwrap()
}

/// Zenoh's own settings admit 100 of them, for 10 s each.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn silent_connections_keep_no_client_out() {
    let service = Service::starting(Default::default());
    let (face, first, _) = face_and_robot(service, Identities::default()).await;
    let locators = face.locators().await;
    let address = locators[0].trim_start_matches("tcp/");
    let mut silent = Vec::new();
    for _ in 0..200 {
        silent.push(TcpStream::connect(address).await.unwrap());
    }
    let second = robot(&face).await;
    let refused = refusal(&second).await;
    assert!(refused.contains("STARTING"), "{refused}");
    drop(silent);
    for robot in [first, second] {
        robot.close().await.unwrap();
    }
    face.stop().await;
}

/// The links stay open for a moment after the last answer, and the queryable with them: it refuses a client that asks
/// then. Without the queryable the client would get no reply.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_that_asks_while_the_links_are_still_open_is_refused() {
    let (face, robot, _) =
        face_and_robot(Service::starting(Default::default()), Identities::default()).await;
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
    let (face, robot, metrics) =
        face_and_robot(Service::starting(Default::default()), Identities::default()).await;
    let publisher = face.open.session.declare_publisher(KEY);
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

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_key_refuses_a_query_without_a_right_token() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let digest = Sha256::digest("secret");
    let digest = hex::encode(digest);
    let robot = "[[identity]]\nname = \"robot\"\nrole = \"admin\"\nindexes = [\"*\"]\n";
    fs::write(file.path(), format!("{robot}token_sha256 = \"{digest}\"\n")).unwrap();
    let identities = Identities::open(Some(file.path())).unwrap();
    let log = Arc::new(MemoryLog::new());
    let (face, robot, _) = face_and_robot(server(&log, &log), identities).await;
    let of_index = Verb::OF_INDEX.map(|(verb, _)| format!("arm/{verb}"));
    let of_server = Verb::OF_SERVER.map(|(verb, _)| verb.to_owned());
    let wildcards = ["**", "*/info", "arm/*"].map(str::to_owned);
    for key in of_index.into_iter().chain(of_server).chain(wildcards) {
        let key = format!("wayfold/v1/{key}");
        for (attachment, expected) in [
            (None, "NO_CREDENTIAL"),
            (Some("secret"), "NO_CREDENTIAL"),
            (Some("token=other"), "WRONG_CREDENTIAL"),
        ] {
            let refused = text(&ask(&robot, &key, attachment).await.unwrap_err());
            assert!(refused.contains(expected), "{key} {attachment:?} {refused}");
        }
    }
    for key in ["wayfold/v1/list", "wayfold/v1/**"] {
        let answer = ask(&robot, key, Some("token=secret")).await.unwrap();
        // A query that names no encoding is in JSON.
        assert_eq!(*answer.encoding(), Encoding::APPLICATION_JSON);
    }
    robot.close().await.unwrap();
    face.stop().await;
}

/// A service with the index `arm`, and its uid.
fn service_with_index() -> (Service, String) {
    let entry = arm();
    let log = log_with(&entry, &[]);
    (server(&log, &log), entry.uid.to_string())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_bytes_of_a_query_are_those_of_its_selector_and_attachment_too() {
    let (service, uid) = service_with_index();
    let (face, robot, _) = face_and_robot(service, Identities::default()).await;
    let padding = "0".repeat(50_000);
    // It waits for a revision that never comes.
    let payload = format!(r#"{{"ids": [0], "min_revision": {{"uid": "{uid}", "number": 1}}}}"#);
    let waiting = robot
        .get(format!("wayfold/v1/arm/get?timeout_ms=2000;_={padding}"))
        .payload(payload)
        .encoding(Encoding::APPLICATION_JSON)
        .attachment("0".repeat(4_000));
    let waiting = waiting.await.unwrap();
    let held = async {
        loop {
            match face.queries.shared.admission.bytes() {
                (0, _) => tokio::task::yield_now().await,
                (held, _) => break held,
            }
        }
    };
    let held = tokio::time::timeout(Duration::from_secs(60), held).await;
    assert!(held.unwrap() > 54_000);
    let refused = waiting.recv_async().await.unwrap().into_result();
    let refused = text(&refused.unwrap_err());
    assert!(refused.contains("DEADLINE_EXCEEDED"), "{refused}");
    robot.close().await.unwrap();
    face.stop().await;
}

/// The turns of both threads: queries wait for them.
fn all_turns(face: &ZenohFace) -> [CallTurns; 2] {
    let flow = face.queries.shared.admission.open();
    [(); 2].map(|()| {
        let mut turns = flow.turns();
        turns.request().unwrap();
        turns
    })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn calls_of_administration_of_one_link_leave_places_to_another() {
    let mut settings = crate::config::Config::default();
    settings.zenoh.max_calls = 4;
    let (service, _) = service_with_index();
    let (face, robot, _) = face_and_robot_with(settings, service, Identities::default()).await;
    let busy = all_turns(&face);
    let lists = (0..4).map(|_| ask(&robot, "wayfold/v1/list", None));
    let mut lists: FuturesUnordered<_> = lists.collect();
    let refused = text(&lists.next().await.unwrap().unwrap_err());
    assert!(refused.contains("TOO_MANY_CALLS"), "{refused}");
    assert!(refused.contains("this link"), "{refused}");
    assert_eq!(face.queries.admin_places.free(), 1);
    drop(busy);
    while let Some(listed) = lists.next().await {
        listed.unwrap();
    }
    robot.close().await.unwrap();
    face.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn calls_that_wait_leave_places_to_administration() {
    let mut settings = crate::config::Config::default();
    settings.zenoh.max_calls = 1;
    let (service, uid) = service_with_index();
    let (face, robot, _) = face_and_robot_with(settings, service, Identities::default()).await;
    // It waits for a revision that never comes.
    let payload = format!(r#"{{"ids": [0], "min_revision": {{"uid": "{uid}", "number": 1}}}}"#);
    let waiting = robot
        .get("wayfold/v1/arm/get?timeout_ms=2000")
        .payload(payload)
        .encoding(Encoding::APPLICATION_JSON);
    let _waiting = waiting.await.unwrap();
    while face.queries.places.free() > 0 {
        tokio::task::yield_now().await;
    }
    ask(&robot, "wayfold/v1/list", None).await.unwrap();
    robot.close().await.unwrap();
    face.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_call_of_administration_that_waits_for_a_turn_ends_at_its_deadline() {
    let (service, _) = service_with_index();
    let (face, robot, _) = face_and_robot(service, Identities::default()).await;
    let busy = all_turns(&face);
    let refused = ask(&robot, "wayfold/v1/list?timeout_ms=50", None).await;
    let refused = text(&refused.unwrap_err());
    assert!(refused.contains("DEADLINE_EXCEEDED"), "{refused}");
    drop(busy);
    robot.close().await.unwrap();
    face.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_query_that_waits_needs_room_at_its_turn() {
    let (service, _) = service_with_index();
    let (face, robot, _) = face_and_robot(service, Identities::default()).await;
    let admission = face.queries.shared.admission.clone();
    let busy = all_turns(&face);
    let asking = ask(&robot, "wayfold/v1/arm/info", None);
    let filling = async {
        while admission.bytes().0 == 0 {
            tokio::task::yield_now().await;
        }
        let unread = admission.open().hold();
        unread.force_take(admission.bytes().1 as usize + 1);
        drop(busy);
        unread
    };
    let (refused, _unread) = tokio::join!(asking, filling);
    let refused = text(&refused.unwrap_err());
    assert!(refused.contains("TOO_MANY_BYTES"), "{refused}");
    robot.close().await.unwrap();
    face.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn administration_is_not_refused_for_its_wait() {
    let mut settings = crate::config::Config::default();
    (
        settings.admission.queue_target_ms,
        settings.admission.burst_ms,
    ) = (0, 0);
    let (service, _) = service_with_index();
    let (face, robot, _) = face_and_robot_with(settings, service, Identities::default()).await;
    let busy = all_turns(&face);
    let asking = async {
        tokio::join!(
            ask(&robot, "wayfold/v1/list", None),
            ask(&robot, "wayfold/v1/arm/info", None)
        )
    };
    let mut asking = pin!(asking);
    let waited = timeout(Duration::from_millis(300), &mut asking).await;
    assert!(waited.is_err(), "a call did not wait for its turn");
    drop(busy);
    let (listed, described) = asking.await;
    let refused = text(&described.unwrap_err());
    assert!(refused.contains("OVERLOADED"), "{refused}");
    listed.unwrap();
    robot.close().await.unwrap();
    face.stop().await;
}
