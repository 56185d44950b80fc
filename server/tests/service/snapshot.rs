//! Snapshots have one pinned revision, unaffected by later mutations, and everything that a restore needs.

use std::time::Duration;

use bytes::Bytes;
use prost::Message;
use wayfold_proto::{snapshot::Reader, v1};
use wayfold_server::service::{Code, Error, Limits};

use crate::support::{snapshots::*, *};

fn request() -> v1::SnapshotIndexRequest {
    v1::SnapshotIndexRequest {
        index_name: "arm".into(),
        min_revision: None,
    }
}

#[tokio::test]
async fn a_snapshot_has_one_revision_despite_later_writes() {
    let (service, uid) = arm("R3").await;
    let rows = cube(7, 20_000);
    let ids: Vec<u64> = (0..20_000).map(|at| at * 3).collect();
    let payload = |id: u64| Bytes::from(format!("point {id}"));
    let request = v1::InsertRequest {
        payloads: ids.iter().map(|&id| payload(id)).collect(),
        ..insertion(&rows, &ids)
    };
    service.insert(&CALL, request).await.unwrap();

    let mut snapshot = service
        .snapshot_index(&CALL, self::request())
        .await
        .unwrap();
    let mut parts = Vec::new();
    while let Some(part) = snapshot.next().await {
        parts.push(part.unwrap().part.unwrap());
        // Between the parts, points are removed, inserted and changed.
        let (gone, left) = ids[parts.len() * 1000..][..1000].split_at(900);
        service.remove(&CALL, removal(gone)).await.unwrap();
        let update = v1::UpdateRequest {
            payloads: vec![Bytes::from_static(b"other"); left.len()],
            tags: vec![5],
            ..updating(left)
        };
        service.update(&CALL, update).await.unwrap();
        insert_rows(&service, &[[0.5; 3]], &[]).await;
    }
    assert!(parts.len() > 4, "{} parts", parts.len());
    let held = read(&parts);
    assert_eq!((held.header.revision, held.header.point_count), (1, 20_000));
    assert_eq!((held.header.name.as_str(), held.header.uid), ("arm", uid));
    assert_eq!(held.header.next_id, 3 * 19_999 + 1);
    assert_eq!(held.ids, ids);
    for ((point, row), id) in held.points.iter().zip(&rows).zip(&ids) {
        assert_eq!(*point, (0, 1, 1, row.to_vec(), payload(*id)));
    }
}

#[tokio::test]
async fn it_tells_which_revision_changed_a_point_last_and_which_ids_were_used() {
    let (service, _) = arm("R1").await;
    insert_rows(&service, &[[0.0], [1.0], [2.0]], &[1, 2, 90]).await;
    let update = v1::UpdateRequest {
        tags: vec![8],
        ..updating(&[2])
    };
    service.update(&CALL, update).await.unwrap();
    service.remove(&CALL, removal(&[90])).await.unwrap();
    let held = read(&snapshot(&service, "arm").await);
    assert_eq!((held.header.revision, held.header.next_id), (3, 91));
    let expected = [
        (0, 1, 1, vec![0.0], Bytes::new()),
        (8, 1, 2, vec![1.0], Bytes::new()),
    ];
    assert_eq!(held.points, expected);
}

#[tokio::test]
async fn parts_are_bounded_for_any_payloads() {
    let (service, _) = arm("R1").await;
    let rows: Vec<[f64; 1]> = (0..200).map(|at| [f64::from(at)]).collect();
    for rows in rows.chunks(50) {
        let request = v1::InsertRequest {
            payloads: vec![vec![7; 65_536].into(); rows.len()],
            ..insertion(rows, &[])
        };
        service.insert(&CALL, request).await.unwrap();
    }
    let parts = snapshot(&service, "arm").await;
    let largest = parts.iter().map(Message::encoded_len).max().unwrap();
    assert!(largest < 400_000, "{largest} bytes");
    assert_eq!(read(&parts).ids.len(), 200);
}

#[tokio::test]
async fn an_empty_index_has_a_header_and_a_trailer() {
    let (service, _) = arm("SO3").await;
    let parts = snapshot(&service, "arm").await;
    assert_eq!(parts.len(), 2);
    assert_eq!(read(&parts).header.revision, 0);
}

#[tokio::test]
async fn snapshots_of_missing_indices_or_revisions_are_refused() {
    let (service, uid) = arm("R1").await;
    let ask = async |name: &str, min_revision| {
        let request = v1::SnapshotIndexRequest {
            index_name: name.into(),
            min_revision,
        };
        let snapshot = service.snapshot_index(&CALL, request).await;
        let (code, reason, _) = refusal(snapshot.map(drop));
        (code, reason)
    };
    assert_eq!(ask("leg", revision("", 0)).await.0, Code::NotFound);
    assert_eq!(
        ask("arm", revision("x", 0)).await.0,
        Code::FailedPrecondition
    );
    let without_uid = (Code::InvalidArgument, "REQUIRED");
    assert_eq!(ask("arm", revision("", 3)).await, without_uid);
    let past = wayfold_server::service::Call {
        deadline: Some(std::time::Instant::now()),
        ..Default::default()
    };
    let late = service.snapshot_index(&past, request()).await;
    assert_eq!(refusal(late.map(drop)).0, Code::DeadlineExceeded);
    let snapshot = v1::SnapshotIndexRequest {
        min_revision: revision(&uid, 0),
        ..request()
    };
    assert!(service.snapshot_index(&CALL, snapshot).await.is_ok());
}

/// The test advances the paused clock.
#[tokio::test(start_paused = true)]
async fn one_that_is_not_read_ends_and_is_no_snapshot() {
    let limits = Limits {
        max_scan_seconds: 10,
        ..Limits::default()
    };
    let (service, _) = arm_with("R3", limits).await;
    insert_rows(&service, &cube(1, 9000), &[]).await;
    let mut snapshot = service.snapshot_index(&CALL, request()).await.unwrap();
    let mut reader = Reader::new();
    for _ in 0..2 {
        let part = snapshot.next().await.unwrap().unwrap().part.unwrap();
        reader.read(&part).unwrap();
    }
    pass(Duration::from_secs(11)).await;
    let error = snapshot.next().await.unwrap().unwrap_err();
    let too_long = Error::HeldTooLong {
        what: "snapshot",
        max_scan_seconds: 10,
    };
    assert_eq!(error, too_long);
    assert!(snapshot.next().await.is_none());
    assert!(reader.finish().is_err());
}
