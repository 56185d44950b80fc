//! A server at rest gives back the memory of its merges, of levels that no reader sees any more, and of payloads that were
//! overwritten while another index was idle.

use std::time::Duration;

use tokio::time::{interval, timeout};
use wayfold_proto::v1::{InsertRequest, OnConflict};
use wayfold_tests::{States, Stubs, figures::resident_bytes, insert_request, row_states, server};

const WIDTH: usize = 32;
const BATCHES: usize = 75;
const ROWS: usize = 2_000;
/// The store takes at most this many bytes for a point beside its state.
const STORED_BYTES: usize = 256;
/// Beside the trees and the stored points, a load takes at most this many bytes.
const MAX_OTHER_BYTES: u64 = 32 * 1024 * 1024;
/// The longest wait for the memory.
const MAX_WAIT: Duration = Duration::from_secs(60);

#[tokio::test]
async fn a_server_at_rest_takes_little_more_than_its_points() {
    // The records that are kept for subscribers would hide the rest.
    let server = server!(; ("WAYFOLD_INDEX__WINDOW_BYTES", "1"));
    let process = server.process().id();
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("arm", &format!("R{WIDTH}")).await;
    let before = resident_bytes(process).unwrap();
    let mut states = States::new(format!("R{WIDTH}").parse().unwrap(), 1);
    for _ in 0..BATCHES {
        let request = insert_request("arm", &states.rows(ROWS), WIDTH);
        stubs.insert(request).await;
    }
    let stored = (BATCHES * ROWS * (8 * WIDTH + STORED_BYTES)) as u64;
    let mut looks = interval(Duration::from_millis(50));
    let shrinking = async {
        loop {
            looks.tick().await;
            let taken = resident_bytes(process).unwrap().saturating_sub(before);
            let trees = stubs.describe("arm").await.memory_bytes;
            println!("{taken} bytes, {trees} of trees, {stored} of stored points");
            if taken <= trees + stored + MAX_OTHER_BYTES {
                break;
            }
        }
    };
    timeout(MAX_WAIT, shrinking).await.unwrap();
}

/// The number of inserts. Each replaces the payloads of the same points.
const INSERTS: u8 = 192;
const POINTS: u64 = 32;
const PAYLOAD_BYTES: usize = 64 * 1024;
/// The inserts write 384 MiB. An old view of the idle index would keep nearly all of them in memory.
const MAX_BESIDE_IDLE_BYTES: u64 = 192 * 1024 * 1024;

#[tokio::test]
async fn an_idle_index_keeps_no_overwritten_payloads_in_memory() {
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().to_str().unwrap();
    let server = server!("--data", data; ("WAYFOLD_INDEX__WINDOW_BYTES", "1"));
    let process = server.process().id();
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("idle", "R1").await;
    stubs.create("arm", "R1").await;
    let before = resident_bytes(process).unwrap();
    let ids: Vec<u64> = (0..POINTS).collect();
    for insert in 0..INSERTS {
        let request = InsertRequest {
            index_name: "arm".into(),
            states: Some(row_states(&vec![0.5; ids.len()], 1)),
            ids: ids.clone(),
            payloads: vec![vec![insert; PAYLOAD_BYTES].into(); ids.len()],
            on_conflict: OnConflict::Replace.into(),
            ..Default::default()
        };
        stubs.insert(request).await;
    }
    let mut looks = interval(Duration::from_millis(50));
    let shrinking = async {
        loop {
            looks.tick().await;
            let taken = resident_bytes(process).unwrap().saturating_sub(before);
            println!("{} MiB", taken >> 20);
            if taken <= MAX_BESIDE_IDLE_BYTES {
                break;
            }
        }
    };
    timeout(MAX_WAIT, shrinking).await.unwrap();
}
