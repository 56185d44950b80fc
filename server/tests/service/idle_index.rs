//! An idle index does not make the store keep data that another index overwrites.

use std::{
    fs,
    path::Path,
    sync::Arc,
    time::{Duration, Instant},
};

use tokio::time::interval;
use wayfold_proto::v1;
use wayfold_server::{
    log::{Durability, FjallLog},
    service::Limits,
};

use crate::support::*;

/// The number of calls to the busy index. Each replaces the payloads of the same points.
const INSERTS: u8 = 128;
const POINTS: u64 = 32;
const PAYLOAD_BYTES: usize = 64 * 1024;

/// The busy index keeps 2 MiB of points and 64 MiB of records. The store keeps a few times that until it has rewritten
/// its files, and over 700 MiB if an old view pins them.
const MAX_TABLE_BYTES: u64 = 320 * 1024 * 1024;

const MAX_WAIT: Duration = Duration::from_secs(30);
const LOOK_INTERVAL: Duration = Duration::from_millis(50);

fn table_bytes(store: &Path) -> u64 {
    let tables = fs::read_dir(store.join("keyspaces/1/tables")).unwrap();
    // fjall may remove a table meanwhile.
    let bytes = tables.map(|table| table.unwrap().metadata().map_or(0, |table| table.len()));
    bytes.sum()
}

#[tokio::test]
async fn an_idle_index_does_not_make_the_store_grow() {
    let directory = tempfile::tempdir().unwrap();
    let log = FjallLog::open(directory.path(), Durability::Fsync).unwrap();
    let service = service_with(Arc::new(log), Limits::default());
    create(&service, "idle", "R1").await;
    create(&service, "arm", "R1").await;
    let ids: Vec<u64> = (0..POINTS).collect();
    for insert in 0..INSERTS {
        let request = v1::InsertRequest {
            payloads: vec![vec![insert; PAYLOAD_BYTES].into(); ids.len()],
            on_conflict: v1::OnConflict::Replace.into(),
            ..insertion(&vec![[0.5]; ids.len()], &ids)
        };
        service.insert(&CALL, request).await.unwrap();
    }
    // The store rewrites its files in the background, on a busy machine a little later. A pinned one would stay.
    let store = directory.path().join("store");
    let (until, mut looks) = (Instant::now() + MAX_WAIT, interval(LOOK_INTERVAL));
    while table_bytes(&store) > MAX_TABLE_BYTES && Instant::now() < until {
        looks.tick().await;
    }
    let bytes = table_bytes(&store);
    println!("{} MiB of tables", bytes >> 20);
    assert!(bytes <= MAX_TABLE_BYTES, "{bytes} bytes of tables");
    assert_eq!(info(&service, "idle").await.point_count, 0);
}
