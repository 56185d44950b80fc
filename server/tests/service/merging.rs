//! Background work behind the calls: the service merges levels and frees removed points.

use std::time::Duration;

use wayfold_proto::v1;
use wayfold_server::service::Service;

use crate::support::*;

/// Waits until the index takes less than `bytes`, and fails after a minute.
async fn shrinks_below(service: &Service, bytes: u64) {
    let shrinking = async {
        while info(service, "arm").await.memory_bytes >= bytes {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(Duration::from_secs(60), shrinking)
        .await
        .unwrap();
}

#[tokio::test]
async fn the_memory_of_removed_points_comes_back() {
    let (service, _) = arm("R3").await;
    let rows = cube(1, 4000);
    for rows in rows.chunks(100) {
        service.insert(&CALL, insertion(rows, &[])).await.unwrap();
    }
    let full = info(&service, "arm").await.memory_bytes;
    let gone: Vec<u64> = (0..3900).collect();
    service.remove(&CALL, removal(&gone)).await.unwrap();
    shrinks_below(&service, full / 4).await;

    let answer = service.knn(&CALL, knn(&rows[3950..3951], 1)).await.unwrap();
    assert_eq!(answer.neighbors.unwrap().ids, [3950]);
    let left = everything(&service).await.points.unwrap().ids;
    assert_eq!(left, (3900..4000).collect::<Vec<_>>());
}

#[tokio::test]
async fn a_scan_keeps_its_points_while_they_are_merged_away() {
    let (service, _) = arm("R3").await;
    let rows = cube(1, 4000);
    service.insert(&CALL, insertion(&rows, &[])).await.unwrap();
    let full = info(&service, "arm").await.memory_bytes;
    let mut scan = service.scan(&CALL, scanning()).await.unwrap();
    let gone: Vec<u64> = (0..3990).collect();
    service.remove(&CALL, removal(&gone)).await.unwrap();
    shrinks_below(&service, full / 4).await;
    let points: v1::Points = scan.next().await.unwrap().unwrap().points.unwrap();
    assert_eq!(points.ids, (0..4000).collect::<Vec<_>>());
    assert_eq!(points.states.unwrap().coordinates, rows.concat());
}
