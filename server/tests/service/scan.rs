//! Scans: parts, the pinned revision, and the maximum time that it is held.

use std::time::Duration;

use bytes::Bytes;
use wayfold_proto::v1;
use wayfold_server::service::{Error, Limits};

use crate::support::*;

#[tokio::test]
async fn parts_add_up_to_the_pinned_revision_despite_later_writes() {
    let (service, _) = arm("R3").await;
    let rows = cube(7, 10_000);
    let ids: Vec<u64> = (0..10_000).map(|at| at * 3).collect();
    let payload = |at: u64| Bytes::from(format!("point {at}"));
    let request = v1::InsertRequest {
        payloads: ids.iter().map(|&id| payload(id)).collect(),
        ..insertion(&rows, &ids)
    };
    service.insert(&CALL, request).await.unwrap();

    let mut scan = service.scan(&CALL, scanning()).await.unwrap();
    let (mut seen, mut coordinates) = (v1::Points::default(), Vec::new());
    let mut parts = 0;
    while let Some(part) = scan.next().await {
        let part = part.unwrap();
        assert_eq!((part.revision.number(), part.point_count), (1, 10_000));
        let points = part.points.unwrap();
        let states = points.states.unwrap();
        assert_eq!(states.row_count as usize, points.ids.len());
        coordinates.extend(states.coordinates);
        seen.ids.extend(points.ids);
        seen.payloads.extend(points.payloads);
        // Between the parts, most points are removed and the rest get other payloads.
        let (gone, left) = ids[parts * 3000..][..3000].split_at(2900);
        service.remove(&CALL, removal(gone)).await.unwrap();
        let update = v1::UpdateRequest {
            payloads: vec![Bytes::from_static(b"other"); left.len()],
            ..updating(left)
        };
        service.update(&CALL, update).await.unwrap();
        parts += 1;
    }
    assert_eq!(parts, 3);
    assert_eq!(seen.ids, ids);
    assert_eq!(coordinates, rows.as_flattened());
    assert_eq!(
        seen.payloads,
        ids.iter().map(|&id| payload(id)).collect::<Vec<_>>()
    );
}

#[tokio::test]
async fn parts_are_bounded_by_bytes_too() {
    let (service, _) = arm("R1").await;
    let rows: Vec<[f64; 1]> = (0..64).map(|at| [f64::from(at)]).collect();
    let request = v1::InsertRequest {
        payloads: vec![vec![7; 60_000].into(); 64],
        ..insertion(&rows, &[])
    };
    service.insert(&CALL, request).await.unwrap();
    let mut scan = service.scan(&CALL, scanning()).await.unwrap();
    let mut seen = Vec::new();
    while let Some(part) = scan.next().await {
        let part = part.unwrap();
        assert!(prost::Message::encoded_len(&part) < 1_200_000);
        seen.extend(part.points.unwrap().ids);
    }
    assert_eq!(seen, (0..64).collect::<Vec<_>>());
}

#[tokio::test]
async fn an_empty_index_has_one_part() {
    let (service, uid) = arm("R1").await;
    let part = everything(&service).await;
    assert_eq!(
        (
            part.revision.number(),
            part.point_count,
            part.revision.uid()
        ),
        (0, 0, uid)
    );
    assert!(part.points.unwrap().ids.is_empty());
}

#[tokio::test]
async fn a_scan_goes_on_after_an_id() {
    let (service, _) = arm("R1").await;
    let last = (1 << 63) - 1;
    let ids: Vec<u64> = (0..100).chain([last]).collect();
    let rows = vec![[0.5]; ids.len()];
    service.insert(&CALL, insertion(&rows, &ids)).await.unwrap();
    for (after, expected) in [
        (0, &ids[1..]),
        (41, &ids[42..]),
        (98, &ids[99..]),
        (99, &[last]),
        (last, &[]),
    ] {
        let request = v1::ScanRequest {
            after_id: Some(after),
            ..scanning()
        };
        let mut scan = service.scan(&CALL, request).await.unwrap();
        let part = scan.next().await.unwrap().unwrap();
        assert_eq!(
            (part.points.unwrap().ids, part.point_count),
            (expected.to_vec(), 101)
        );
        assert!(scan.next().await.is_none());
    }
}

/// The test advances the paused clock.
#[tokio::test(start_paused = true)]
async fn a_scan_that_holds_its_snapshot_too_long_ends_and_another_goes_on() {
    let limits = Limits {
        max_scan_seconds: 10,
        ..Limits::default()
    };
    let (service, _) = arm_with("R3", limits).await;
    insert_rows(&service, &cube(1, 9000), &[]).await;

    let mut scan = service.scan(&CALL, scanning()).await.unwrap();
    let first = scan.next().await.unwrap().unwrap().points.unwrap();
    pass(Duration::from_secs(11)).await;
    let last = first.ids.last().copied();
    let error = scan.next().await.unwrap().unwrap_err();
    let too_long = Error::ScanTooLong {
        max_scan_seconds: 10,
        after_id: last,
    };
    assert_eq!(error, too_long);
    assert!(scan.next().await.is_none());

    let rest = v1::ScanRequest {
        after_id: last,
        ..scanning()
    };
    let mut scan = service.scan(&CALL, rest).await.unwrap();
    let mut ids = first.ids;
    while let Some(part) = scan.next().await {
        ids.extend(part.unwrap().points.unwrap().ids);
    }
    assert_eq!(ids, (0..9000).collect::<Vec<_>>());
}

#[tokio::test]
async fn a_scan_waits_for_the_revision_it_asks_after() {
    use futures_util::FutureExt;
    let (service, uid) = arm("R1").await;
    let request = v1::ScanRequest {
        filter: Some(v1::Filter {
            since_revision: revision(&uid, 1),
            ..Default::default()
        }),
        ..scanning()
    };
    let mut scanning = std::pin::pin!(service.scan(&CALL, request));
    assert!((&mut scanning).now_or_never().is_none());
    insert_rows(&service, &[[1.0]], &[]).await;
    scanning.await.unwrap();
}
