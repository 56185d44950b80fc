//! The code of a call alone: the server's layer around the service, on this thread.

use std::{path::Path, sync::Arc, time::Instant};

use bytes::{BufMut, Bytes, BytesMut};
use http::{HeaderValue, Request, header};
use prost::Message;
use wayfold_proto::v1::{CreateIndexRequest, create_index_request::SpaceForm};
use wayfold_server::{
    InProcess,
    config::Config,
    log::MemoryLog,
    registry::{Registry, RegistryOptions},
    service::{Call, Limits, Service},
};
use wayfold_tests::{States, insert_request, knn_request};

use crate::{Added, INDEX, K, POINTS, SPACE, TOKEN, WIDTH};

/// The calls of a turn: so few that most turns are not interrupted.
const CALLS: usize = 20;
/// The turns of a round.
const TURNS: usize = 2_000;

/// The contestants. Each is named after its addition to the first one.
const CONTESTANTS: [&str; 6] = [
    "",
    "admission",
    "authentication",
    "metrics",
    "both",
    "nothing",
];

pub(crate) async fn measure(identities: &Path, rounds: usize) -> Vec<(&'static str, Added)> {
    let mut added: Vec<_> = CONTESTANTS[1..]
        .iter()
        .map(|what| (*what, Added::default()))
        .collect();
    for round in 0..rounds {
        let mut contestants = Vec::new();
        for what in CONTESTANTS {
            let with_identities = matches!(what, "authentication" | "both");
            let with_metrics = matches!(what, "metrics" | "both");
            let mut config = Config::default();
            config.http.listen = if with_metrics { "127.0.0.1:0" } else { "off" }.to_owned();
            let calls = InProcess::new(
                &config,
                service(round).await,
                with_identities.then_some(identities),
            );
            contestants.push((calls.expect("identities"), requests(round, with_identities)));
        }
        for turn in 0..TURNS {
            let mut took = [0.0; CONTESTANTS.len()];
            // Each contestant is first as often as the others.
            for at in 0..CONTESTANTS.len() {
                let at = (at + turn) % CONTESTANTS.len();
                let (calls, requests) = &mut contestants[at];
                took[at] = turn_us(calls, requests, CONTESTANTS[at] == "admission").await;
            }
            for ((_, added), us) in added.iter_mut().zip(&took[1..]) {
                added.push(*us, took[0]);
            }
        }
    }
    added
}

/// The mean time of a call of this turn. With `admits` each is admitted once more.
async fn turn_us(calls: &mut InProcess, requests: &[Request<Bytes>], admits: bool) -> f64 {
    // The copies are no work of the server.
    let requests = requests.to_vec();
    let began = Instant::now();
    for request in requests {
        assert!(!admits || calls.admit().await);
        let (answer, _) = calls.call(request).await;
        assert!(!answer.is_empty());
    }
    began.elapsed().as_secs_f64() * 1e6 / CALLS as f64
}

/// A service with an index.
async fn service(round: usize) -> Service {
    let registry = Registry::new(Arc::new(MemoryLog::new()), RegistryOptions::default());
    registry.replay().expect("an empty log");
    let service = Service::new(registry, Limits::default());
    service.set_ready();
    let create = CreateIndexRequest {
        name: INDEX.into(),
        space_form: Some(SpaceForm::SpaceText(SPACE.into())),
        ..Default::default()
    };
    let created = service.create_index(&Call::default(), create).await;
    created.expect("an index");
    let mut states = States::new(SPACE.parse().expect("a space"), round as u64);
    let insert = insert_request(INDEX, &states.rows(POINTS), WIDTH);
    let inserted = service.insert(&Call::default(), insert).await;
    inserted.expect("points");
    service
}

/// The calls of a turn, with the token if there are identities.
fn requests(round: usize, with_token: bool) -> Vec<Request<Bytes>> {
    const COMPRESSION: u8 = 0;
    let mut states = States::new(SPACE.parse().expect("a space"), 1_000 + round as u64);
    let request = |_| {
        let knn = knn_request(INDEX, &states.row(), WIDTH, K);
        let mut framed = BytesMut::new();
        framed.put_u8(COMPRESSION);
        framed.put_u32(knn.encoded_len() as u32);
        framed.put_slice(&knn.encode_to_vec());
        let mut request = Request::post("/wayfold.v1.PointService/Knn").body(framed.freeze());
        let headers = request.as_mut().expect("a request").headers_mut();
        headers.insert(
            header::CONTENT_TYPE,
            HeaderValue::from_static("application/grpc"),
        );
        if with_token {
            let value = format!("Bearer {TOKEN}").parse().expect("a header");
            headers.insert(header::AUTHORIZATION, value);
        }
        request.expect("a request")
    };
    (0..CALLS).map(request).collect()
}
