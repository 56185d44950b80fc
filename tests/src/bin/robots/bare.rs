//! A bare queryable: answers made in advance, of the size of the server's.

use std::process::ExitCode;

use prost::Message;
use serde_json::json;
use wayfold_proto::v1::{KnnResponse, Neighbors, Revision};
use zenoh::{Config, Wait, bytes::Encoding};

use crate::K;

const UID: &str = "00000000-0000-4000-8000-000000000000";

/// Answers until it is killed. It prints its address as the server does.
pub(crate) fn main() -> ExitCode {
    let config = json!({
        "listen": { "endpoints": ["tcp/127.0.0.1:0"] },
        "scouting": { "multicast": { "enabled": false }, "gossip": { "enabled": false } },
    });
    let config = Config::from_json5(&config.to_string()).expect("a configuration");
    let session = zenoh::open(config).wait().expect("a session");
    // The numbers have a typical number of digits.
    let distances: Vec<f64> = (1..=K).map(|rank| (f64::from(rank) / 7.0).sqrt()).collect();
    let ids: Vec<u64> = (0..K).map(|rank| u64::from(rank) * 4_999).collect();
    let in_json = json!({
        "ids": [ids], "distances": [distances], "revision": { "uid": UID, "number": 50 }
    });
    let in_json = in_json.to_string().into_bytes();
    let answer = KnnResponse {
        neighbors: Some(Neighbors {
            neighbor_counts: vec![K],
            ids,
            distances,
            ..Default::default()
        }),
        revision: Some(Revision {
            uid: UID.into(),
            number: 50,
        }),
    };
    let in_protobuf = answer.encode_to_vec();
    let _queryable = session
        .declare_queryable("wayfold/v1/**")
        .callback(move |query| {
            let protobuf = query.encoding() == Some(&Encoding::APPLICATION_PROTOBUF);
            let (answer, encoding) = match protobuf {
                true => (&in_protobuf, Encoding::APPLICATION_PROTOBUF),
                false => (&in_json, Encoding::APPLICATION_JSON),
            };
            let reply = query
                .reply(query.key_expr(), answer.clone())
                .encoding(encoding);
            reply.wait().expect("a reply");
        })
        .wait()
        .expect("a queryable");
    let locators = session.info().locators().wait();
    println!("listening on http://none");
    println!("listening on {}", locators.first().expect("a listener"));
    loop {
        std::thread::park();
    }
}
