//! Streams of frames.

use std::time::Duration;

use axum::body::BodyDataStream;
use bytes::Bytes;
use futures_util::StreamExt;
use tokio::time::{Instant, timeout};

use super::*;
use crate::{extremes::EXTREMES, quiet::quietly};

async fn open(router: &mut Router, path: &str) -> BodyDataStream {
    let answer = ask(router, Request::post(format!("/api/v1/{path}")), "").await;
    assert_eq!(answer.status(), StatusCode::OK);
    answer.into_body().into_data_stream()
}

async fn next(body: &mut BodyDataStream) -> Bytes {
    body.next().await.unwrap().unwrap()
}

#[tokio::test]
async fn all_points_are_sent_once_with_their_columns() {
    let service = service().await;
    let mut router = router(&service, Identities::default());
    let frames = all_frames(&mut router, "").await;
    let kinds: Vec<&Value> = frames.iter().map(|(head, ..)| &head["kind"]).collect();
    assert_eq!(kinds, ["begin", "points", "at"]);
    let begin = &frames[0].0;
    assert_eq!(begin["coordinate_count"], 2);
    assert_eq!(begin["point_count"], POINTS);
    assert_eq!(begin["share"], 1.0);
    let (_, described) = post(&mut router, "arm/info", json!({})).await;
    assert_eq!(begin["revision"], described["index"]["revision"]);
    assert_eq!(begin["oldest_revision"]["uid"], begin["revision"]["uid"]);
    assert_eq!(frames[1].1, (0..POINTS).collect::<Vec<_>>());
    assert_eq!(frames[1].2[6..8], [3.0, 0.5]);
    assert_eq!(frames[2].0["revision"], begin["revision"]);
}

#[tokio::test]
async fn edges_are_sent_to_those_who_ask_for_them() {
    let mut router = router(&service().await, Identities::default());
    let frames = all_frames(&mut router, "edges=true").await;
    let kinds: Vec<&Value> = frames.iter().map(|(head, ..)| &head["kind"]).collect();
    assert_eq!(kinds, ["begin", "points", "edges", "at"]);
    assert_eq!(frames[2].0["row_count"], 2 * POINTS);
    let from = (0..POINTS).flat_map(|id| [id; 2]);
    let to = (0..POINTS).flat_map(|id| [(id + 1) % 10, (id + 9) % 10]);
    assert_eq!(frames[2].1, from.chain(to).collect::<Vec<u64>>());
}

/// An index `encoded` with one point of this payload, and the edges that are sent of it.
async fn edges_of(encoding: v1::PayloadEncoding, payload: &[u8]) -> Vec<u64> {
    let service = service().await;
    let request = v1::CreateIndexRequest {
        name: "encoded".into(),
        space_form: Some(v1::create_index_request::SpaceForm::SpaceText("R1".into())),
        payload_encoding: encoding.into(),
    };
    let call = Call::default();
    service.create_index(&call, request).await.unwrap();
    let request = v1::InsertRequest {
        index_name: "encoded".into(),
        states: Some(v1::States {
            row_count: 1,
            coordinates: vec![0.5],
        }),
        payloads: vec![payload.to_owned().into()],
        ..Default::default()
    };
    service.insert(&call, request).await.unwrap();
    let mut router = router(&service, Identities::default());
    let request = Request::post("/api/v1/encoded/points?edges=true");
    let answer = ask(&mut router, request, "").await.into_body();
    let sent = to_bytes(answer, usize::MAX).await.unwrap();
    let frames = heads(&sent);
    let edges = frames.iter().find(|(head, _)| head["kind"] == "edges");
    let numbers = edges.map(|(_, body)| body.as_chunks::<8>().0.iter());
    let numbers = numbers.into_iter().flatten();
    numbers.map(|it| u64::from_le_bytes(*it)).collect()
}

#[tokio::test]
async fn edges_are_read_as_the_index_declares() {
    use v1::PayloadEncoding::{Edges, Unspecified, WeightedEdges};
    let payload = [7_u64, 2.5_f64.to_bits(), 9, 0.5_f64.to_bits()];
    let payload = payload.map(u64::to_le_bytes).concat();
    let costs = [2.5, 0.5].map(f64::to_bits);
    assert_eq!(edges_of(WeightedEdges, &payload).await, [0, 0, 7, 9]);
    let all = [0, 0, 0, 0, 7, costs[0], 9, costs[1]];
    assert_eq!(edges_of(Edges, &payload).await, all);
    assert_eq!(edges_of(Unspecified, &payload).await, [0_u64; 0]);
    assert_eq!(edges_of(Edges, b"a name").await, [0_u64; 0]);
    assert_eq!(edges_of(WeightedEdges, &payload[..24]).await, [0_u64; 0]);
}

#[tokio::test(start_paused = true)]
async fn the_overview_has_each_second_what_list_and_metrics_have() {
    let service = service().await;
    let mut router = router(&service, Identities::default());
    let began = Instant::now();
    let mut body = open(&mut router, "overview").await;
    for points in [POINTS, POINTS + 1] {
        let sent = next(&mut body).await;
        assert_eq!(began.elapsed().as_secs(), points - POINTS);
        let frames = heads(&sent);
        assert_eq!(frames.len(), 1);
        let head = &frames[0].0;
        assert_eq!(head["kind"], "overview");
        let (_, listed) = post(&mut router, "list", json!({})).await;
        assert_eq!(head["list"]["indexes"], listed["indexes"]);
        assert_eq!(head["list"]["indexes"][0]["point_count"], points);
        let metrics = head["metrics"].as_str().unwrap();
        assert!(metrics.ends_with("# EOF\n"), "{metrics}");
        insert(&service, points).await;
    }
}

#[test]
fn an_overview_that_takes_long_is_rare_and_not_silent() {
    let after = |elapsed| overview::period_after(Duration::from_millis(elapsed)).as_millis();
    assert_eq!([0, 100, 500, 3000].map(after), [1000, 1000, 5000, 10_000]);
}

#[tokio::test]
async fn a_stream_goes_on_after_the_revision_of_its_caller() {
    let service = service().await;
    let mut router = router(&service, Identities::default());
    let begun = all_frames(&mut router, "").await;
    let begun = &begun[0].0["revision"];
    let uid = begun["uid"].as_str().unwrap();
    remove(&service, 3).await;
    let path = format!("arm/points?follow=true&after={uid}:{}", POINTS - 1);
    let mut body = open(&mut router, &path).await;
    let mut seen = Vec::new();
    while seen
        .last()
        .is_none_or(|(head, ..): &(Value, _, _)| head["revision"]["number"] != POINTS + 1)
    {
        seen.extend(frames(&next(&mut body).await));
    }
    let kinds: Vec<&Value> = seen.iter().map(|(head, ..)| &head["kind"]).collect();
    assert_eq!(kinds, ["at", "points", "removed", "at"]);
    assert_eq!((&seen[1].1, &seen[2].1), (&vec![POINTS - 1], &vec![3]));
    for at in [0, 2, 3] {
        assert_eq!(seen[at].0["revision"]["uid"], uid);
    }

    // Another uid begins anew.
    let path = "arm/points?follow=true&after=00000000-0000-0000-0000-000000000000:7";
    let mut body = open(&mut router, path).await;
    assert_eq!(
        frames(&next(&mut body).await)[0].0,
        json!({ "kind": "reset", "reason": "UID_CHANGED" })
    );
    assert_eq!(frames(&next(&mut body).await)[0].0["kind"], "begin");
}

/// The page draws a picture now and then: it must not look like a subscriber that is behind.
#[tokio::test]
async fn the_page_is_no_subscriber() {
    let service = service().await;
    let mut router = router(&service, Identities::default());
    let mut body = open(&mut router, "arm/points?follow=true").await;
    for revision in [POINTS, POINTS + 1] {
        let mut reached = Value::Null;
        while reached != revision {
            let sent = next(&mut body).await;
            reached = heads(&sent).last().unwrap().0["revision"]["number"].clone();
        }
        insert(&service, revision).await;
    }
    let listed = service.listed().into_iter();
    let subscribers = listed.map(|(_, state)| state.hosted().unwrap().subscribers.count_and_lag(0));
    assert_eq!(subscribers.collect::<Vec<_>>(), [(0, 0)]);
}

#[tokio::test(start_paused = true)]
async fn a_stream_without_mutations_says_that_it_lives() {
    let mut router = router(&service().await, Identities::default());
    let mut body = open(&mut router, "arm/points?follow=true").await;
    let mut ends = 0;
    while ends < 4 {
        let frames = frames(&next(&mut body).await);
        ends += frames.iter().filter(|it| it.0["kind"] == "at").count();
    }
}

/// A sample has about as many points as asked for, and a wrong parameter is refused with its name.
#[tokio::test]
async fn more_points_than_asked_for_are_sampled() {
    let service = service().await;
    for id in POINTS..1000 {
        insert(&service, id).await;
    }
    let mut router = router(&service, Identities::default());
    let frames = all_frames(&mut router, "max=200").await;
    let sent: usize = frames
        .iter()
        .map(|(_, ids, coordinates)| coordinates.len().min(ids.len()))
        .sum();
    assert!((120..280).contains(&sent), "{sent}");
    assert_eq!(frames[0].0["point_count"], 1000);
    let begin = &frames[0].0;
    assert!((begin["share"].as_f64().unwrap() - 0.2).abs() < 1e-9);
    assert_eq!(begin["oldest_revision"]["number"], 0);
    // The same sample is followed from the beginning, and from a revision on.
    let mut sampled: Vec<u64> = frames.iter().flat_map(|it| it.1.clone()).collect();
    let (uid, share) = (begin["revision"]["uid"].as_str().unwrap(), &begin["share"]);
    let path = format!("arm/points?after={uid}:0&share={share}");
    let mut body = open(&mut router, &path).await;
    let mut followed = Vec::new();
    let mut reached = Value::Null;
    while reached != 1000 {
        for (head, ids, _) in self::frames(&next(&mut body).await) {
            followed.extend(ids);
            reached = head["revision"]["number"].clone();
        }
    }
    sampled.sort_unstable();
    followed.sort_unstable();
    assert_eq!(followed, sampled);
    for query in [
        "max=0",
        "max=x",
        "follow=yes",
        "after=7",
        "after=x:y",
        "share=2",
        "share=NaN",
        "k=3",
    ] {
        let request = Request::post(format!("/api/v1/arm/points?{query}"));
        let refused = ask(&mut router, request, "").await;
        assert_eq!(refused.status(), StatusCode::BAD_REQUEST, "{query}");
    }
}

/// The points that a mutation stores in the place of others are told before it; new points, and those with another tag, are not.
#[tokio::test]
async fn a_stream_tells_which_points_are_replaced() {
    let service = service().await;
    let put = async |id: u64, x: f64, tag: u64| {
        let request = v1::InsertRequest {
            index_name: "arm".into(),
            ids: vec![id],
            tags: vec![tag],
            states: Some(v1::States {
                row_count: 1,
                coordinates: vec![x, 0.5],
            }),
            on_conflict: v1::OnConflict::Replace.into(),
            ..Default::default()
        };
        service.insert(&Call::default(), request).await.unwrap();
    };
    put(3, 7.25, 0).await;
    let tag = v1::UpdateRequest {
        index_name: "arm".into(),
        ids: vec![4],
        tags: vec![9],
        ..Default::default()
    };
    service.update(&Call::default(), tag).await.unwrap();
    put(POINTS, 1.0, 0).await;
    let mut router = router(&service, Identities::default());
    let (_, described) = post(&mut router, "arm/info", json!({})).await;
    let uid = described["index"]["revision"]["uid"].as_str().unwrap();
    let newest = POINTS + 3;
    let path = format!("arm/points?after={uid}:{POINTS}");
    let mut body = open(&mut router, &path).await;
    let (mut seen, mut reached) = (Vec::new(), Value::Null);
    while reached != newest {
        for (head, body) in heads(&next(&mut body).await) {
            match body.first_chunk() {
                Some(id) => {
                    let kind = head["kind"].as_str().unwrap().to_owned();
                    seen.push((kind, u64::from_le_bytes(*id)));
                }
                None => reached = head["revision"]["number"].clone(),
            }
        }
    }
    let seen: Vec<(&str, u64)> = seen.iter().map(|(kind, id)| (&**kind, *id)).collect();
    let expected = [
        ("replaced", 3),
        ("points", 3),
        ("points", 4),
        ("points", POINTS),
    ];
    assert_eq!(seen, expected);
}

/// A stream that waits says each ten seconds that it lives. The clock of the test is paused, so its end comes at once.
#[tokio::test(start_paused = true)]
async fn points_are_answered_or_refused_for_extreme_integers() {
    let service = service().await;
    let mut router = router(&service, Identities::default());
    let (_, described) = post(&mut router, "arm/info", json!({})).await;
    let uid = described["index"]["revision"]["uid"].as_str().unwrap();
    let extremes = EXTREMES.map(|integer| integer.to_string());
    let malformed = ["-1", "18446744073709551616", "1e30", "0x10", ""];
    for integer in extremes.iter().map(|it| &**it).chain(malformed) {
        for query in [
            format!("max={integer}"),
            format!("after={uid}:{integer}"),
            format!("after={uid}:{integer}&follow=true&max={integer}"),
            format!("max={integer}&follow=true"),
        ] {
            println!("{query}");
            let request = Request::post(format!("/api/v1/arm/points?{query}"));
            let read = async {
                let answer = ask(&mut router, request, "").await;
                let status = answer.status();
                let body = to_bytes(answer.into_body(), usize::MAX);
                (status, timeout(Duration::from_secs(60), body).await)
            };
            let (status, body) = quietly(read).await;
            let is_refused = malformed.contains(&integer)
                || query.contains("max=0")
                || (query.contains("after") && integer == "18446744073709551615");
            match is_refused {
                true => assert_eq!(status, StatusCode::BAD_REQUEST, "{query}"),
                false => assert_eq!(status, StatusCode::OK, "{query}"),
            }
            // A stream that ends has sent all points.
            let waits = !is_refused && query != format!("max={integer}");
            assert_eq!(body.is_err(), waits, "{query}");
        }
    }
}
