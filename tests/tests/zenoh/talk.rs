//! The forms of a query: keys, parameters, payloads, encodings.

use std::collections::BTreeSet;

use futures_util::{StreamExt, future::join_all, stream::FuturesUnordered};
use prost::Message;
use serde_json::{Value, json};
use wayfold_proto::v1;
use wayfold_tests::insert_request;
use zenoh::bytes::Encoding;

use crate::robot::{MAX_WAIT, Robot, reason, server, server_with};

async fn with_indices(robot: &Robot, names: &[&str]) {
    for name in names {
        let create = json!({ "name": name, "space_text": "R2" });
        robot.json("create", create).await.unwrap();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn wildcards_reach_what_tells_of_the_indices_and_change_nothing() {
    let (_server, locator) = server();
    let robot = Robot::connect(&locator).await;
    // An index may have the name of a verb.
    let names = ["arm", "leg", "list", "create"];
    with_indices(&robot, &names).await;
    let body = json!({ "states": [[1, 2]], "name": "more", "space_text": "R1", "ids": [0] });
    let keys = async |selector: &str| -> BTreeSet<String> {
        let payload = body.to_string().into_bytes();
        let reply = robot
            .all(selector, payload, Encoding::APPLICATION_JSON)
            .await;
        let keys: Vec<String> = reply.into_iter().map(|it| it.unwrap().key).collect();
        let distinct: BTreeSet<String> = keys.iter().cloned().collect();
        assert_eq!(distinct.len(), keys.len(), "{keys:?}");
        distinct
    };
    let infos: BTreeSet<String> = names.map(|name| format!("wayfold/v1/{name}/info")).into();
    let mut everything = infos.clone();
    everything.insert("wayfold/v1/list".into());
    assert_eq!(keys("wayfold/v1/*/info").await, infos);
    assert_eq!(keys("wayfold/v1/**").await, everything);
    assert_eq!(keys("**").await, everything);
    assert_eq!(
        keys("wayfold/v1/*").await,
        ["wayfold/v1/list".to_owned()].into()
    );
    assert_eq!(
        keys("wayfold/v1/arm/*").await,
        ["wayfold/v1/arm/info".to_owned()].into()
    );
    assert_eq!(
        keys("wayfold/*/l$*/info").await,
        ["wayfold/v1/leg/info", "wayfold/v1/list/info"]
            .map(String::from)
            .into()
    );
    for selector in ["*/knn", "*/insert", "arm/rem$*", "crea$*", "*/log"] {
        let refused = robot.json(selector, body.clone()).await.unwrap_err();
        assert_eq!(reason(&refused), (3, "WILDCARD"), "{selector}");
    }
    let listed = robot.json("list", Value::Null).await.unwrap();
    let listed = listed["indexes"].as_array().unwrap().clone();
    assert_eq!(listed.len(), names.len());
    assert!(listed.iter().all(|index| index["revision"]["number"] == 0));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn states_parameters_and_payloads_say_one_thing() {
    let (_server, locator) = server();
    let robot = Robot::connect(&locator).await;
    with_indices(&robot, &["arm"]).await;
    let rows = json!({ "states": [[0, 0], [3, 4]], "ids": [7, 8] });
    robot.json("arm/insert", rows).await.unwrap();
    let nearest = robot.json("arm/knn?k=1", json!([3, 3])).await.unwrap();
    assert_eq!(nearest["ids"], json!([[8]]));
    assert_eq!(nearest["distances"], json!([[1.0]]));
    for (selector, body) in [
        ("arm/knn?k=2;r=4.5;eps=0", json!({ "states": [[0, 1]] })),
        ("arm/knn?k=2;r=4.5", json!([[0, 1]])),
        (
            "arm/knn?radius=4.5;k=2",
            json!({ "states": [[0, 1]], "k": 2 }),
        ),
        ("arm/query?r=4.5;timeout_ms=60000", json!([0, 1])),
        ("arm/query", json!({ "states": [0, 1], "radius": 4.5 })),
    ] {
        let near = robot.json(selector, body).await.unwrap();
        assert_eq!(near["ids"], json!([[7, 8]]), "{selector}");
    }
    for (selector, body, expected) in [
        (
            "arm/knn?k=1",
            json!({ "states": [[0, 1]], "k": 2 }),
            (3, "CONFLICT"),
        ),
        (
            "arm/knn?k=1",
            json!({ "states": [[0, 1]], "index_name": "leg" }),
            (3, "CONFLICT"),
        ),
        ("arm/knn?k=1;kk=2", json!([0, 1]), (3, "UNKNOWN_PARAMETER")),
        (
            "arm/knn?k=1",
            json!({ "state": [0, 1] }),
            (3, "UNKNOWN_FIELD"),
        ),
        (
            "arm/knn?k=1;timeout_ms=soon",
            json!([0, 1]),
            (3, "MALFORMED_TIMEOUT"),
        ),
        (
            "arm/knn?k=1;timeout_ms=0",
            json!([0, 1]),
            (4, "DEADLINE_EXCEEDED"),
        ),
        ("arm/knn?k=1", json!([0, 1, 2]), (3, "WIDTH")),
        ("leg/knn?k=1", json!([0, 1]), (5, "INDEX_NOT_FOUND")),
        ("arm/kn", json!([0, 1]), (3, "UNKNOWN_KEY")),
        ("arm", Value::Null, (3, "UNKNOWN_KEY")),
        ("arm/remove?ids=7", Value::Null, (3, "REQUIRED")),
        ("delete?index_name=arm", Value::Null, (3, "REQUIRED")),
    ] {
        let refused = robot.json(selector, body).await.unwrap_err();
        assert_eq!(reason(&refused), expected, "{selector}");
    }
    let kept = robot.json("arm/get?ids=7,8", Value::Null).await.unwrap();
    assert_eq!(kept["points"]["states"], json!([[0.0, 0.0], [3.0, 4.0]]));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn answers_come_in_the_form_of_the_question() {
    let (_server, locator) = server();
    let robot = Robot::connect(&locator).await;
    with_indices(&robot, &["arm"]).await;
    let info = "wayfold/v1/arm/info";
    for (encoding, form) in [
        (Encoding::APPLICATION_PROTOBUF, "application/protobuf"),
        (
            Encoding::APPLICATION_PROTOBUF.with_schema("wayfold.v1.GetIndexRequest"),
            "application/protobuf",
        ),
        (Encoding::APPLICATION_JSON, "application/json"),
        (Encoding::TEXT_JSON, "application/json"),
        (Encoding::ZENOH_STRING, "application/json"),
        (Encoding::ZENOH_BYTES, "application/json"),
    ] {
        let reply = robot.ask(info, Vec::new(), encoding.clone()).await.unwrap();
        assert_eq!((&*reply.encoding, &*reply.key), (form, info), "{encoding}");
        if form == "application/protobuf" {
            let index = v1::GetIndexResponse::decode(&*reply.payload).unwrap().index;
            assert_eq!(index.unwrap().name, "arm");
        }
        let unknown = robot
            .ask("wayfold/v1/leg/info", Vec::new(), encoding.clone())
            .await;
        assert_eq!(unknown.unwrap_err().encoding, form, "{encoding}");
    }
    for unknown in [Encoding::IMAGE_PNG, "application/protobuffer".into()] {
        let refused = robot.ask(info, Vec::new(), unknown).await.unwrap_err();
        assert_eq!(reason(&refused.json()), (3, "UNKNOWN_ENCODING"));
    }
    let malformed = robot
        .ask(
            "wayfold/v1/arm/knn",
            vec![0xff],
            Encoding::APPLICATION_PROTOBUF,
        )
        .await;
    let status = v1::Status::decode(&*malformed.unwrap_err().payload).unwrap();
    assert_eq!(status.code, 3);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn oversized_requests_are_refused_with_a_message() {
    let settings = [("WAYFOLD_ZENOH__MAX_MESSAGE_BYTES", "1000")];
    let (_server, locator) = server_with(&[], &settings);
    let robot = Robot::connect(&locator).await;
    with_indices(&robot, &["arm"]).await;
    let large = json!({ "states": vec![[0.5, 0.5]; 100] });
    let refused = robot.json("arm/insert", large).await.unwrap_err();
    assert_eq!(reason(&refused), (8, "LIMIT_EXCEEDED"));
    assert!(
        refused["message"]
            .as_str()
            .unwrap()
            .contains("zenoh.max_message_bytes = 1000")
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn calls_beyond_the_limit_are_refused() {
    let settings = [("WAYFOLD_ZENOH__MAX_CALLS", "1")];
    let (mut server, locator) = server_with(&["--http", "127.0.0.1:0"], &settings);
    let pages = server.pages();
    let robot = Robot::connect(&locator).await;
    // Not over Zenoh: the place of a call is free only after its answer has arrived.
    let mut stubs = wayfold_tests::Stubs::connect(server.uri()).await;
    stubs.create("arm", "R2").await;
    let uid = stubs.describe("arm").await.revision.unwrap().uid;

    // This call waits and keeps the only place until the insert below takes effect.
    let at = json!({ "uid": uid, "number": 1 });
    let at = json!({ "ids": [0], "min_revision": at });
    let waiting = robot.json("arm/get?timeout_ms=60000", at);
    let others = async {
        // This call is refused as soon as the other one has the place.
        let refused = loop {
            if let Err(refused) = robot.json("arm/info", Value::Null).await {
                break refused;
            }
        };
        assert_eq!(reason(&refused), (8, "TOO_MANY_CALLS"));
        assert!(refused.to_string().contains("google.rpc.RetryInfo"));
        let (_, metrics) = wayfold_tests::page(&pages, "/metrics", "");
        let counted = "wayfold_refused_calls_total{reason=\"TOO_MANY_CALLS\"} 1\n";
        assert!(metrics.contains(counted), "{metrics}");
        stubs.insert(insert_request("arm", &[1.0, 2.0], 2)).await;
    };
    let (reply, ()) = tokio::join!(waiting, others);
    assert_eq!(reply.unwrap()["points"]["states"], json!([[1.0, 2.0]]));
    let free = async { while robot.json("arm/info", Value::Null).await.is_err() {} };
    tokio::time::timeout(MAX_WAIT, free).await.unwrap();
}

/// A link has no more places than it leaves to the others.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn calls_of_one_link_leave_places_to_another() {
    let (server, locator) = server_with(&[], &[("WAYFOLD_ZENOH__MAX_CALLS", "4")]);
    let (greedy, other) = (
        Robot::connect(&locator).await,
        Robot::connect(&locator).await,
    );
    let mut stubs = wayfold_tests::Stubs::connect(server.uri()).await;
    stubs.create("arm", "R2").await;
    let uid = stubs.describe("arm").await.revision.unwrap().uid;
    // They wait until the insert below takes effect.
    let at = json!({ "uid": uid, "number": 1 });
    let at = json!({ "ids": [0], "min_revision": at });
    let waiting = (0..4).map(|_| greedy.json("arm/get?timeout_ms=60000", at.clone()));
    let mut waiting: FuturesUnordered<_> = waiting.collect();
    let refused = waiting.next().await.unwrap().unwrap_err();
    assert_eq!(reason(&refused), (8, "TOO_MANY_CALLS"));
    assert!(refused.to_string().contains("this link"), "{refused}");
    other.json("arm/info", Value::Null).await.unwrap();
    stubs.insert(insert_request("arm", &[1.0, 2.0], 2)).await;
    while let Some(reply) = waiting.next().await {
        reply.unwrap();
    }
}

/// Of the links that hold all places, the one with the most loses a place of a query that waits for a revision.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn queries_that_wait_for_a_revision_leave_places_to_another_link() {
    let (server, locator) = server_with(&[], &[("WAYFOLD_ZENOH__MAX_CALLS", "4")]);
    let (greedy, modest) = (
        Robot::connect(&locator).await,
        Robot::connect(&locator).await,
    );
    let other = Robot::connect(&locator).await;
    let mut stubs = wayfold_tests::Stubs::connect(server.uri()).await;
    stubs.create("arm", "R2").await;
    let uid = stubs.describe("arm").await.revision.unwrap().uid;
    // They wait until the insert below takes effect.
    let at = json!({ "uid": uid, "number": 1 });
    let at = json!({ "ids": [0], "min_revision": at });
    let waiting = (0..4).map(|_| greedy.json("arm/get?timeout_ms=60000", at.clone()));
    let mut waiting: FuturesUnordered<_> = waiting.collect();
    let refused = waiting.next().await.unwrap().unwrap_err();
    assert!(refused.to_string().contains("this link"), "{refused}");
    // It takes the last place, or one of a query that waits already.
    let last = async {
        loop {
            match modest.json("arm/get?timeout_ms=60000", at.clone()).await {
                Err(refused) if reason(&refused) == (8, "TOO_MANY_CALLS") => {}
                reply => break reply,
            }
        }
    };
    let others = async {
        let lost = loop {
            tokio::select! {
                lost = waiting.next() => break lost.unwrap().unwrap_err(),
                reply = other.json("arm/info", Value::Null) => drop(reply),
            }
        };
        assert_eq!(reason(&lost), (8, "TOO_MANY_CALLS"));
        assert!(lost.to_string().contains("another link"), "{lost}");
        assert!(lost.to_string().contains("google.rpc.RetryInfo"), "{lost}");
        stubs.insert(insert_request("arm", &[1.0, 2.0], 2)).await;
        while let Some(reply) = waiting.next().await {
            // The other link may have needed a second place before the first was free.
            if let Err(lost) = reply {
                assert_eq!(reason(&lost), (8, "TOO_MANY_CALLS"));
            }
        }
    };
    let (reply, ()) = tokio::join!(last, others);
    reply.unwrap();
}

/// Each is refused with a message, and the server goes on answering others.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_flood_of_malformed_queries_is_refused_one_by_one() {
    let (server, locator) = server();
    let flood = Robot::connect(&locator).await;
    let robot = Robot::connect(&locator).await;
    with_indices(&robot, &["arm"]).await;
    let nested = "[".repeat(100_000);
    let payloads: [(&[u8], Encoding); 6] = [
        (b"\xff\xff\xff\xff\xff", Encoding::APPLICATION_PROTOBUF),
        (b"\x12\xff\xff\xff\xff\x0f", Encoding::APPLICATION_PROTOBUF),
        (nested.as_bytes(), Encoding::APPLICATION_JSON),
        (b"{\"states\":", Encoding::APPLICATION_JSON),
        (b"\x00", Encoding::ZENOH_BYTES),
        (b"{}", Encoding::IMAGE_PNG),
    ];
    let verbs = [
        "arm/knn",
        "arm/query",
        "arm/insert",
        "arm/update",
        "arm/remove",
        "arm/get",
        "arm/log",
        "create",
    ];
    let mut refused = 0;
    for _ in 0..20 {
        let mut replies = Vec::new();
        for verb in verbs {
            for (payload, encoding) in &payloads {
                let selector = format!("wayfold/v1/{verb}");
                let flood = &flood;
                replies.push(async move {
                    flood
                        .ask(&selector, payload.to_vec(), encoding.clone())
                        .await
                });
            }
        }
        for reply in join_all(replies).await {
            assert!(reply.is_err(), "{reply:?}");
            refused += 1;
        }
        let reply = robot.json("arm/insert", json!([[1, 2]])).await.unwrap();
        assert_eq!(reply["outcomes"], json!(["INSERTED"]));
    }
    assert_eq!(refused, 20 * verbs.len() * payloads.len());
    let reply = robot.json("arm/info", Value::Null).await.unwrap();
    assert_eq!(reply["index"]["point_count"], 20);
    drop(server);
}
