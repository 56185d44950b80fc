//! The routes that the page reads.

mod bounds;
mod figures;
mod streams;

use std::{fs, sync::Arc};

use axum::{
    body::{Body, to_bytes},
    http::{Request, StatusCode, header},
    response::Response,
};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use tower::Service as _;
use wayfold_proto::v1;

use super::*;
use crate::{
    config::Config,
    identity::Identities,
    lifecycle::Lifecycle,
    log::MemoryLog,
    registry::{Registry, RegistryOptions},
    service::{Call, Limits, Service},
};

const POINTS: u64 = 10;

/// A service with `arm`, whose points 0 to 9 have their ids as states, revision 1 + id, and 100 + id as tags.
async fn service() -> Service {
    let registry = Registry::new(Arc::new(MemoryLog::new()), RegistryOptions::default());
    let service = Service::new(registry, Limits::default());
    service.set_ready();
    let call = Call::default();
    let request = v1::CreateIndexRequest {
        name: "arm".into(),
        space_form: Some(v1::create_index_request::SpaceForm::SpaceText("R2".into())),
        payload_encoding: v1::PayloadEncoding::Edges.into(),
    };
    service.create_index(&call, request).await.unwrap();
    for id in 0..POINTS {
        insert(&service, id).await;
    }
    service
}

async fn insert(service: &Service, id: u64) {
    let request = v1::InsertRequest {
        index_name: "arm".into(),
        ids: vec![id],
        tags: vec![100 + id],
        // The ids of its two neighbours on a ring of ten.
        payloads: vec![
            [(id + 1) % 10, (id + 9) % 10]
                .map(u64::to_le_bytes)
                .concat()
                .into(),
        ],
        states: Some(v1::States {
            row_count: 1,
            coordinates: vec![id as f64, 0.5],
        }),
        ..Default::default()
    };
    service.insert(&Call::default(), request).await.unwrap();
}

async fn remove(service: &Service, id: u64) {
    let request = v1::RemoveRequest {
        index_name: "arm".into(),
        ids: vec![id],
        ..Default::default()
    };
    service.remove(&Call::default(), request).await.unwrap();
}

fn router(service: &Service, identities: Identities) -> Router {
    routes(pages(service, identities), false)
}

fn pages(service: &Service, identities: Identities) -> Pages {
    let shared = FaceContext::new(&Config::default(), service.clone(), identities);
    let phases = Lifecycle::starting().watch();
    let addresses = Arc::new(Addresses {
        grpc: ([0, 0, 0, 0], 50051).into(),
        pages: Some(([127, 0, 0, 1], 8080).into()),
        members: None,
        has_tls: true,
        has_identities: false,
        zenoh: Vec::new(),
        warnings: Vec::new(),
    });
    Pages {
        shared,
        phases,
        addresses,
        under_way: TaskTracker::new(),
    }
}

async fn ask(router: &mut Router, request: axum::http::request::Builder, body: &str) -> Response {
    let request = request.header(header::HOST, "127.0.0.1:8080");
    let request: Request<Body> = request.body(body.to_owned().into()).unwrap();
    router.call(request).await.unwrap()
}

async fn post(router: &mut Router, key: &str, body: Value) -> (StatusCode, Value) {
    let request = Request::post(format!("/api/v1/{key}"));
    let answer = ask(router, request, &body.to_string()).await;
    let status = answer.status();
    let bytes = to_bytes(answer.into_body(), usize::MAX).await.unwrap();
    (status, serde_json::from_slice(&bytes).unwrap())
}

/// The heads and the bodies of frames.
fn heads(mut bytes: &[u8]) -> Vec<(Value, &[u8])> {
    let mut frames = Vec::new();
    while let Some((lengths, rest)) = bytes.split_first_chunk::<8>() {
        let length = |at: usize| u32::from_le_bytes(lengths[at..at + 4].try_into().unwrap());
        let (head, rest) = rest.split_at(length(0) as usize);
        let (body, rest) = rest.split_at(length(4) as usize);
        bytes = rest;
        assert_eq!((head.len() % 8, body.len() % 8), (0, 0));
        frames.push((serde_json::from_slice(head).unwrap(), body));
    }
    frames
}

/// The heads of frames, with the ids and the first coordinates of points.
fn frames(bytes: &[u8]) -> Vec<(Value, Vec<u64>, Vec<f32>)> {
    let mut frames = Vec::new();
    for (head, body) in heads(bytes) {
        let count = head["row_count"].as_u64().unwrap_or(0) as usize;
        let numbers = body
            .chunks_exact(8)
            .map(|it| u64::from_le_bytes(it.try_into().unwrap()));
        let columns = if head["kind"] == "edges" { 2 } else { 1 };
        let ids: Vec<u64> = numbers.clone().take(columns * count).collect();
        let mut coordinates = Vec::new();
        if head["kind"] == "points" {
            let columns: Vec<u64> = numbers.take(3 * count).collect();
            for (row, id) in ids.iter().enumerate() {
                assert_eq!(columns[count + row], id + 1, "the revision of {id}");
                assert_eq!(columns[2 * count + row], id + 100, "the tag of {id}");
            }
            let floats = body[24 * count..].chunks_exact(4);
            let floats = floats.map(|it| f32::from_le_bytes(it.try_into().unwrap()));
            coordinates = floats.take(2 * count).collect();
        }
        frames.push((head, ids, coordinates));
    }
    frames
}

async fn all_frames(router: &mut Router, query: &str) -> Vec<(Value, Vec<u64>, Vec<f32>)> {
    let request = Request::post(format!("/api/v1/arm/points?{query}"));
    let answer = ask(router, request, "").await;
    assert_eq!(answer.status(), StatusCode::OK);
    frames(&to_bytes(answer.into_body(), usize::MAX).await.unwrap())
}

#[tokio::test]
async fn verbs_that_read_answer_as_over_zenoh() {
    let mut router = router(&service().await, Identities::default());
    let body = json!({ "states": [[3.2, 0.5]], "k": 2 });
    let (status, answer) = post(&mut router, "arm/knn", body).await;
    assert_eq!(status, StatusCode::OK);
    assert_eq!(answer["ids"], json!([[3, 4]]));
    let (_, listed) = post(&mut router, "list", json!({})).await;
    assert_eq!(listed["indexes"][0]["space_text"], "R2");

    for (key, body, expected, reason) in [
        (
            "arm/knn",
            json!({ "states": [[1.0]], "k": 2 }),
            400,
            "WIDTH",
        ),
        (
            "leg/knn",
            json!({ "states": [[1.0]], "k": 2 }),
            404,
            "INDEX_NOT_FOUND",
        ),
        (
            "arm/insert",
            json!({ "states": [[1.0, 2.0]] }),
            400,
            "READ_ONLY",
        ),
        ("delete", json!({ "index_name": "arm" }), 400, "READ_ONLY"),
        ("arm/fly", json!({}), 400, "UNKNOWN_KEY"),
        ("arm/log?from=0", json!({}), 400, "UNKNOWN_PARAMETER"),
    ] {
        let (status, refused) = post(&mut router, key, body).await;
        assert_eq!(status.as_u16(), expected, "{key} {refused}");
        assert_eq!(refused["details"][0]["reason"], reason, "{key} {refused}");
        // The list of an unknown verb has only verbs that this listener answers.
        let words = refused["message"].as_str().unwrap();
        let offered = words
            .split(", ")
            .any(|it| it.ends_with("knn") || it == "scan");
        assert_eq!(offered, reason == "UNKNOWN_KEY", "{words}");
        assert!(!words.contains("session"), "{words}");
    }
}

#[tokio::test]
async fn programs_learn_where_grpc_is() {
    let mut router = router(&service().await, Identities::default());
    let (status, found) = post(&mut router, "addresses", json!({})).await;
    assert_eq!(status, StatusCode::OK);
    let expected = json!({
        "grpc": { "address": "0.0.0.0:50051", "has_tls": true },
        "http": { "address": "127.0.0.1:8080", "has_tls": false },
        "has_identities": false,
    });
    assert_eq!(found, expected);
}

#[tokio::test]
async fn strangers_and_wrong_roles_see_nothing() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let digest = Sha256::digest("secret");
    let digest = hex::encode(digest);
    let text = format!(
        "[[identity]]\nname = \"leg\"\nrole = \"read\"\nindexes = [\"leg\"]\ntoken_sha256 = \"{digest}\"\n"
    );
    fs::write(file.path(), text).unwrap();
    let identities = Identities::open(Some(file.path())).unwrap();
    let mut router = router(&service().await, identities);
    for (token, expected) in [
        (None, StatusCode::UNAUTHORIZED),
        (Some("wrong"), StatusCode::UNAUTHORIZED),
        (Some("secret"), StatusCode::FORBIDDEN),
    ] {
        for (request, body) in [
            (
                Request::post("/api/v1/arm/knn"),
                r#"{"states": [[1.0, 2.0]], "k": 1}"#,
            ),
            (Request::post("/api/v1/arm/info"), ""),
            (Request::post("/api/v1/arm/points"), ""),
        ] {
            let request = match token {
                Some(token) => request.header(header::AUTHORIZATION, format!("Bearer {token}")),
                None => request,
            };
            let refused = ask(&mut router, request, body).await;
            assert_eq!(refused.status(), expected, "{token:?}");
        }
    }
    let listing = Request::post("/api/v1/list").header(header::AUTHORIZATION, "Bearer secret");
    let listed = ask(&mut router, listing, "").await;
    let listed = to_bytes(listed.into_body(), usize::MAX).await.unwrap();
    assert!(!String::from_utf8_lossy(&listed).contains("arm"));
}

#[tokio::test]
async fn another_origin_reads_nothing_and_probes_answer_everyone() {
    let mut router = router(&service().await, Identities::default());
    let request = Request::post("/api/v1/list").header("sec-fetch-site", "cross-site");
    assert_eq!(
        ask(&mut router, request, "").await.status(),
        StatusCode::FORBIDDEN
    );
    let request: Request<Body> = Request::post("/api/v1/list")
        .header(header::HOST, "evil.example")
        .body(Body::empty())
        .unwrap();
    assert_eq!(
        router.call(request).await.unwrap().status(),
        StatusCode::FORBIDDEN
    );
    for (path, expected) in [
        ("/healthz", StatusCode::OK),
        ("/metrics", StatusCode::OK),
        ("/readyz", StatusCode::SERVICE_UNAVAILABLE),
    ] {
        let request: Request<Body> = Request::get(path)
            .header(header::HOST, "server:8080")
            .body(Body::empty())
            .unwrap();
        assert_eq!(
            router.call(request).await.unwrap().status(),
            expected,
            "{path}"
        );
    }
    let page = ask(&mut router, Request::get("/"), "").await;
    let policy = page.headers()[header::CONTENT_SECURITY_POLICY]
        .to_str()
        .unwrap();
    assert!(policy.starts_with("default-src 'none'"), "{policy}");
}
