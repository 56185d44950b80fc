//! Refusals of large queries, and the memory that refusals keep.

use super::*;
use crate::verbs::MAX_DYNAMIC_BYTES;

/// A refusal keeps its query, and so a selector that is as long as a message.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_link_that_reads_no_refusals_keeps_no_long_selectors() {
    let (service, _) = service_with_index();
    let (face, robot, _) = face_and_robot(service, Identities::default()).await;
    // Zenoh calls it on the thread that reads the link, and so reads no more until `open` is dropped.
    let (open, gate) = mpsc::channel::<()>();
    let gate = Arc::new(Mutex::new(gate));
    // A refusal has the key of its query: these fill the link soon.
    let selector = format!("wayfold/v1/{}?_={}", "a".repeat(60_000), "0".repeat(10_000));
    let asking = std::thread::spawn(move || {
        for _ in 0..600 {
            let gate = Arc::clone(&gate);
            let wait = move |_| {
                let _ = gate.lock().unwrap().recv();
            };
            // It fails once the server has closed the link.
            if robot.get(&selector).callback(wait).wait().is_err() {
                break;
            }
        }
        robot
    });
    while !asking.is_finished() && face.open.session.info().transports().await.next().is_some() {
        let kept = MAX_REFUSALS - face.queries.refusals.available_permits();
        assert_eq!(kept, 0);
        tokio::task::yield_now().await;
    }
    drop(open);
    asking.join().unwrap().close().await.unwrap();
    face.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn large_attachments_selectors_and_texts_are_refused() {
    let (service, _) = service_with_index();
    let (face, robot, _) = face_and_robot(service, Identities::default()).await;
    let info = "wayfold/v1/arm/info";
    let attachment = |bytes: usize| format!("traceparent={}", "0".repeat(bytes - 12));
    let selector = |bytes: usize| format!("{info}?_={}", "0".repeat(bytes - info.len() - 3));
    ask(&robot, &selector(65_536), Some(&attachment(4_096)))
        .await
        .unwrap();
    for (selector, attachment, expected) in [
        (
            info.to_owned(),
            Some(attachment(4_097)),
            "ATTACHMENT_TOO_LONG",
        ),
        (selector(65_537), None, "SELECTOR_TOO_LONG"),
    ] {
        let refused = ask(&robot, &selector, attachment.as_deref()).await;
        let refused = text(&refused.unwrap_err());
        assert!(refused.contains(expected), "{refused}");
    }
    let (json, protobuf) = (Encoding::APPLICATION_JSON, Encoding::APPLICATION_PROTOBUF);
    for (parameters, encoding, bytes, expected) in [
        ("", &json, MAX_DYNAMIC_BYTES, "MALFORMED"),
        ("", &json, MAX_DYNAMIC_BYTES + 1, "JSON_TOO_LONG"),
        ("", &protobuf, MAX_DYNAMIC_BYTES + 1, "MALFORMED"),
        ("?k=1", &protobuf, MAX_DYNAMIC_BYTES, "MALFORMED"),
        (
            "?k=1",
            &protobuf,
            MAX_DYNAMIC_BYTES + 1,
            "TOO_LONG_WITH_PARAMETERS",
        ),
    ] {
        let long = robot.get(format!("wayfold/v1/arm/knn{parameters}"));
        let long = long
            .payload("\x7f".repeat(bytes))
            .encoding(encoding.clone());
        let long = long.await.unwrap();
        let refused = long.recv_async().await.unwrap().into_result();
        let refused = text(&refused.unwrap_err());
        assert!(refused.contains(expected), "{refused}");
    }
    robot.close().await.unwrap();
    face.stop().await;
}
