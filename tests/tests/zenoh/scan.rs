//! `scan`: all points of one revision, page by page.

use prost::Message;
use serde_json::{Value, json};
use wayfold_proto::v1;
use wayfold_tests::{INCLUDE_ALL, Stubs, number};
use zenoh::bytes::Encoding;

use crate::robot::{Robot, reason, server, server_with};

async fn page(robot: &Robot, request: &v1::ScanRequest) -> v1::ScanResponse {
    let payload = request.encode_to_vec();
    let encoding = Encoding::APPLICATION_PROTOBUF;
    let reply = robot.ask("wayfold/v1/arm/scan", payload, encoding).await;
    v1::ScanResponse::decode(&*reply.unwrap().payload).unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pages_in_both_forms_are_the_parts_of_a_stream() {
    let (server, locator) = server();
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("arm", "R2").await;
    let robot = Robot::connect(&locator).await;
    let insert = json!({ "states": vec![[0.5, 1.5]; 10_000], "tags": vec![7; 10_000] });
    robot.json("arm/insert", insert).await.unwrap();
    let first = v1::ScanRequest {
        index_name: "arm".into(),
        include: Some(INCLUDE_ALL),
        ..Default::default()
    };
    let mut stream = stubs.points.scan(first.clone()).await.unwrap().into_inner();
    let mut request = first;
    let mut pages = 0;
    while let Some(part) = stream.message().await.unwrap() {
        let of_stream = part.clone();
        let found = page(&robot, &request).await;
        pages += 1;
        assert_eq!(found.held_scan.is_empty(), pages == 3);
        request.held_scan.clone_from(&found.held_scan);
        request.after_id = part.points.unwrap().ids.last().copied();
        let expected = v1::ScanResponse {
            held_scan: found.held_scan.clone(),
            ..of_stream
        };
        assert_eq!(found, expected);
        let gone = json!({ "ids": [9_000 + pages, 10_000] });
        robot.json("arm/remove", gone).await.unwrap();
    }
    assert_eq!(pages, 3);

    let (mut after, mut held, mut ids) = (Value::Null, String::new(), Vec::new());
    loop {
        let selector = match &after {
            Value::Null => "arm/scan?page_size=2500;include=tags".to_owned(),
            after => {
                format!("arm/scan?page_size=2500;include=tags;after_id={after};held_scan={held}")
            }
        };
        let found = robot.json(&selector, Value::Null).await.unwrap();
        let points = found["points"].clone();
        assert_eq!(found["point_count"], 9_997);
        assert_eq!(found["revision"]["number"], 4);
        let of_page = points["ids"].as_array().unwrap().clone();
        assert_eq!(points["tags"], json!(vec![7; of_page.len()]));
        assert_eq!(points.get("states"), None);
        after = of_page.last().unwrap().clone();
        ids.extend(of_page);
        held = found["held_scan"].as_str().unwrap().to_owned();
        if held.is_empty() {
            break;
        }
        let gone = json!({ "ids": [after] });
        robot.json("arm/remove", gone).await.unwrap();
    }
    let expected = (0..10_000).filter(|id| !(9_001..=9_003).contains(id));
    assert!(ids.iter().map(|id| id.as_u64().unwrap()).eq(expected));
    let info = stubs.describe("arm").await;
    assert_eq!(number(&info.revision), 7);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn held_revisions_are_limited_and_a_lost_one_is_named() {
    let settings = [("WAYFOLD_LIMITS__MAX_HELD_SCANS", "1")];
    let (_server, locator) = server_with(&[], &settings);
    let robot = Robot::connect(&locator).await;
    let create = json!({ "name": "arm", "space_text": "R2" });
    robot.json("create", create).await.unwrap();
    let insert = json!({ "states": vec![[0.5, 1.5]; 3] });
    robot.json("arm/insert", insert).await.unwrap();
    let begin = || robot.json("arm/scan", json!({ "page_size": 1 }));
    let first = begin().await.unwrap();
    let full = begin().await.unwrap_err();
    assert_eq!(reason(&full), (8, "LIMIT_EXCEEDED"));
    let next = |held: Value| json!({ "after_id": 0, "held_scan": held });
    let last = robot.json("arm/scan", next(first["held_scan"].clone()));
    assert_eq!(last.await.unwrap()["points"]["ids"], json!([1, 2]));
    let ended = robot.json("arm/scan", next(first["held_scan"].clone()));
    assert_eq!(reason(&ended.await.unwrap_err()), (9, "SCAN_ENDED"));
    begin().await.unwrap();
}
