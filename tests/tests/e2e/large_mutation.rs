//! A mutation that takes more messages than an atomic batch of NATS has at most is refused, and the index goes on working. The
//! environment variable `NATS_SERVER` has the path of the program nats-server.

use std::time::Duration;

use tonic::{Code, Request};
use wayfold_proto::v1::{InsertRequest, UpdateRequest};
use wayfold_tests::{Refusal, ServerProcess, Stubs, nats::Nats, row_states};

use crate::nats_settings::start;

/// The largest payload of a point.
const PAYLOAD_BYTES: usize = 64 * 1024;

/// With such payloads their record takes 1,017 messages of 64 KiB.
const POINTS: u64 = 1000;

/// An insert of this many points is below `grpc.max_message_bytes`.
const POINTS_PER_INSERT: usize = 100;

/// Without the refusal the update would be evaluated again until then.
const MAX_WAIT: Duration = Duration::from_secs(60);

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mutation_that_no_batch_of_nats_holds_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    // Its max_payload is 64 KiB.
    let nats = Nats::start(directory.path(), 1);
    let server = ServerProcess::ready(start(&nats));
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("arm", "R1").await;
    let ids: Vec<u64> = (0..POINTS).collect();
    for ids in ids.chunks(POINTS_PER_INSERT) {
        let rows: Vec<f64> = ids.iter().map(|id| *id as f64).collect();
        let request = InsertRequest {
            index_name: "arm".into(),
            states: Some(row_states(&rows, 1)),
            ids: ids.to_vec(),
            payloads: vec![vec![7; PAYLOAD_BYTES].into(); ids.len()],
            ..Default::default()
        };
        stubs.insert(request).await;
    }

    let tagging = |ids: &[u64]| {
        let mut request = Request::new(UpdateRequest {
            index_name: "arm".into(),
            ids: ids.to_vec(),
            tags: vec![1],
            ..Default::default()
        });
        request.set_timeout(MAX_WAIT);
        request
    };
    let status = stubs.points.update(tagging(&ids)).await.unwrap_err();
    let refusal = Refusal::of(&status);
    let refused = (refusal.code, &*refusal.reason);
    assert_eq!(refused, (Code::ResourceExhausted, "LIMIT_EXCEEDED"));
    assert!(status.message().contains("split the call"), "{status:?}");
    for ids in ids.chunks(ids.len() / 2) {
        let updated = stubs.points.update(tagging(ids)).await.unwrap();
        assert_eq!(updated.into_inner().updated_count, ids.len() as u64);
    }
}
