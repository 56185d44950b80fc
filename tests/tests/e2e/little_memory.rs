//! A server with little memory refuses inserts before it is killed, and starts again with less than its indices take:
//! they can be listed and deleted then, and inserts go on.

use std::{path::Path, time::Duration};

use tokio::time::timeout;
use tonic::{Code, Status};
use tonic_health::pb::health_check_response::ServingStatus;
use wayfold::{Client, RetryPolicy};
use wayfold_proto::v1::{CreateIndexRequest, ListIndexesRequest, create_index_request::SpaceForm};
use wayfold_tests::{
    Refusal, ServerProcess, Signal, States, Stubs, figures::anonymous_bytes, insert_request, server,
};

use crate::{health::health, metrics::figures};

const MIB: u64 = 1024 * 1024;
const LIMIT: u64 = 128 * MIB;
const WIDTH: usize = 32;
const ROWS: usize = 2_000;
/// The longest wait for freed memory.
const MAX_WAIT: Duration = Duration::from_secs(60);

fn serve(data: &Path, limit: u64) -> ServerProcess {
    let (data, limit) = (data.to_str().unwrap(), limit.to_string());
    server!("--http", "127.0.0.1:0", "--data", data; ("WAYFOLD_MEMORY__LIMIT_BYTES", &*limit))
}

/// The bytes that only the server's process holds.
fn used(server: &ServerProcess) -> u64 {
    anonymous_bytes(server.process().id()).unwrap()
}

/// The inserts of one program.
struct Inserts {
    stubs: Stubs,
    rows: Vec<f64>,
}

impl Inserts {
    async fn next(&mut self, name: &str) -> Result<(), Status> {
        let request = insert_request(name, &self.rows, WIDTH);
        self.stubs.points.insert(request).await.map(drop)
    }
}

#[tokio::test]
async fn a_full_server_refuses_inserts_and_serves_what_it_can_after_a_start() {
    let directory = tempfile::tempdir().unwrap();
    let mut server = serve(directory.path(), LIMIT);
    let pages = server.pages();
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("arm", &format!("R{WIDTH}")).await;
    let mut inserts = Inserts {
        stubs: stubs.clone(),
        rows: States::new(format!("R{WIDTH}").parse().unwrap(), 1).rows(ROWS),
    };
    let (mut stored, mut peak, mut all_refused) = (0, 0, 0.0);
    // A refusal may end once points are moved to the disk; this many in a row say that memory is full.
    let mut refused = 0;
    while refused < 50 {
        match inserts.next("arm").await {
            Ok(()) => (stored, refused) = (stored + ROWS as u64, 0),
            Err(status) => {
                let refusal = Refusal::of(&status);
                let expected = (Code::ResourceExhausted, "MEMORY_FULL");
                assert_eq!((refusal.code, &*refusal.reason), expected, "{status:?}");
                refused += 1;
                all_refused += 1.0;
            }
        }
        peak = peak.max(used(&server));
    }
    println!("{stored} points, peak {} MiB", peak / MIB);
    assert!(peak < LIMIT, "{peak}");
    let counted = "wayfold_refused_calls_total{reason=\"MEMORY_FULL\"}";
    assert_eq!(figures(&pages)[counted], all_refused);
    assert_eq!(stubs.describe("arm").await.point_count, stored);
    let finished = server.stop(Signal::Kill);
    assert!(!finished.stderr.contains("ERROR"), "{}", finished.stderr);

    let server = serve(directory.path(), LIMIT);
    let mut again = Stubs::connect(server.uri()).await;
    assert_eq!(again.describe("arm").await.point_count, stored);
    let loaded = used(&server);
    assert!(loaded < LIMIT, "{loaded}");
    server.stop(Signal::Kill);

    // The number of points that fit differs from run to run, so the limit that is too low for them follows from it.
    let too_low = loaded / 3 * 2;
    let server = serve(directory.path(), too_low);
    let mut stubs = Stubs::connect(server.uri()).await;
    let listed = stubs.indexes.list_indexes(ListIndexesRequest::default());
    let listed = listed.await.unwrap().into_inner();
    assert_eq!((listed.indexes.len(), listed.damaged.len()), (0, 1));
    assert_eq!(listed.damaged[0].name, "arm");
    let mut inserts = Inserts { stubs, ..inserts };
    let refusal = Refusal::of(&inserts.next("arm").await.unwrap_err());
    assert_eq!(
        (refusal.code, &*refusal.reason),
        (Code::Unavailable, "NOT_LOADED")
    );
    let unloaded = used(&server);
    println!("{loaded} bytes loaded, {unloaded} without the index");
    assert!(unloaded < too_low, "{unloaded}");
    // The client does not wait until the index is loaded.
    let client = Client::builder().retry(RetryPolicy::until_deadline());
    let client = client.connect(server.uri()).await.unwrap();
    client.delete_index("arm").await.unwrap();
    inserts.stubs.create("arm", &format!("R{WIDTH}")).await;
    let accepted = async { while inserts.next("arm").await.is_err() {} };
    timeout(MAX_WAIT, accepted).await.unwrap();
    assert_eq!(inserts.stubs.describe("arm").await.point_count, ROWS as u64);
    let finished = server.stop(Signal::Terminate);
    assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);
}

#[tokio::test]
async fn health_tells_reading_and_writing_apart() {
    let server = server!("--data", "memory"; ("WAYFOLD_MEMORY__LIMIT_BYTES", "1048576"));
    let mut stubs = Stubs::connect(server.uri()).await;
    let created = stubs.indexes.create_index(CreateIndexRequest {
        name: "arm".to_owned(),
        space_form: Some(SpaceForm::SpaceText("R2".to_owned())),
        ..Default::default()
    });
    let refusal = Refusal::of(&created.await.unwrap_err());
    assert_eq!(refusal.reason, "MEMORY_FULL");
    let status = async |name| health(server.uri(), name).await;
    assert_eq!(status("wayfold.writing").await, ServingStatus::NotServing);
    for name in ["", "wayfold.reading", "wayfold.indices"] {
        assert_eq!(status(name).await, ServingStatus::Serving, "{name}");
    }
    server.stop(Signal::Terminate);
}
