//! A slow disk delays only the calls that read from it: other calls are answered, on a single thread and on one index.

mod overtaken;

use std::sync::Arc;

use futures_util::future::BoxFuture;
use wayfold_proto::v1;
use wayfold_server::service::{Error, Limits, Service};

use crate::{fault::FaultLog, support::*};

/// Serves the content of the log with empty caches.
fn serving(log: &FaultLog) -> Service {
    restarted_with(Arc::new(log.clone()), options(), Limits::default())
}

fn payload(id: u64) -> bytes::Bytes {
    format!("payload {id}").into()
}

/// A log of `arm` with the points 0, 1, …, 9 and their payloads, and the index's uid.
async fn ten_points() -> (FaultLog, String) {
    let log = FaultLog::new(0);
    let service = serving(&log);
    let uid = create(&service, "arm", "R1").await;
    service.insert(&CALL, first_points(10)).await.unwrap();
    (log, uid)
}

/// The points below `end`, each at the coordinate that is its id.
fn first_points(end: u64) -> v1::InsertRequest {
    let ids: Vec<u64> = (0..end).collect();
    let rows: Vec<[f64; 1]> = ids.iter().map(|id| [*id as f64]).collect();
    v1::InsertRequest {
        payloads: ids.iter().map(|id| payload(*id)).collect(),
        ..insertion(&rows, &ids)
    }
}

fn include() -> Option<v1::Include> {
    Some(v1::Include {
        with_payloads: true,
        ..Default::default()
    })
}

/// The payloads of this many nearest neighbours.
fn neighbor_payloads(k: u32) -> Option<v1::NeighborSpec> {
    Some(v1::NeighborSpec {
        k_form: nearest(k),
        include: include(),
        ..Default::default()
    })
}

/// A call that reads from the disk and checks its answer.
type Reading = fn(Service, String) -> BoxFuture<'static, Result<(), Error>>;

/// The calls that must not hold the writer while they read.
const READING: [(&str, Reading); 11] = [
    ("Get", |service, _| {
        Box::pin(async move {
            let points = service.get(&CALL, getting(&[3, 7])).await?.points.unwrap();
            assert_eq!(points.payloads, [payload(3), payload(7)]);
            Ok(())
        })
    }),
    ("Scan", |service, _| {
        Box::pin(async move {
            let mut scan = service.scan(&CALL, scanning()).await?;
            let points = scan.next().await.unwrap()?.points.unwrap();
            assert!(points.payloads.into_iter().eq((0..10).map(payload)));
            Ok(())
        })
    }),
    ("Knn", |service, _| {
        Box::pin(async move {
            let request = v1::KnnRequest {
                include: include(),
                ..knn(&[[3.1], [8.9]], 2)
            };
            let neighbors = service.knn(&CALL, request).await?.neighbors.unwrap();
            assert_eq!(neighbors.ids, [3, 4, 9, 8]);
            assert!(neighbors.payloads.into_iter().eq([3, 4, 9, 8].map(payload)));
            Ok(())
        })
    }),
    ("Query", |service, _| {
        Box::pin(async move {
            let request = v1::QueryRequest {
                index_name: "arm".into(),
                states: states(&[[3.1]]),
                radius_form: within(1.0),
                include: include(),
                ..Default::default()
            };
            let neighbors = service.query(&CALL, request).await?.neighbors.unwrap();
            assert!(neighbors.payloads.into_iter().eq([3, 4].map(payload)));
            Ok(())
        })
    }),
    ("SnapshotIndex", |service, _| {
        Box::pin(async move {
            let request = v1::SnapshotIndexRequest {
                index_name: "arm".into(),
                min_revision: None,
            };
            let mut snapshot = service.snapshot_index(&CALL, request).await?;
            let mut parts = 0;
            while let Some(part) = snapshot.next().await {
                part?;
                parts += 1;
            }
            assert_eq!(parts, 3);
            Ok(())
        })
    }),
    ("VerifyIndex", |service, _| {
        Box::pin(async move {
            let request = v1::VerifyIndexRequest {
                index_name: "arm".into(),
                ..Default::default()
            };
            let mut verification = service.verify_index(&CALL, request).await?;
            while let Some(answer) = verification.next().await {
                answer?;
            }
            Ok(())
        })
    }),
    ("Watch", |service, uid| {
        Box::pin(async move {
            let mut watch = service.watch(&CALL, watching(&uid, 0)).await?;
            watch.next().await.unwrap()?;
            let mutations = watch.next().await.unwrap()?.mutations;
            let stored = mutations[0].stored.as_ref().unwrap();
            assert!(stored.payloads.iter().cloned().eq((0..10).map(payload)));
            Ok(())
        })
    }),
    ("Insert of stored points", |service, _| {
        Box::pin(async move {
            let outcomes = service.insert(&CALL, first_points(10)).await?.outcomes;
            assert_eq!(outcomes, [i32::from(v1::Outcome::Unchanged); 10]);
            Ok(())
        })
    }),
    ("Insert with neighbours' payloads", |service, _| {
        Box::pin(async move {
            let request = v1::InsertRequest {
                payloads: vec!["own".into(), "own".into()],
                neighbor_spec: neighbor_payloads(2),
                ..insertion(&[[3.1], [3.2]], &[])
            };
            let neighbors = service.insert(&CALL, request).await?.neighbors.unwrap();
            assert_eq!(neighbors.ids[..2], [3, 4]);
            // The second row finds the first.
            assert_eq!(neighbors.ids[3], 3);
            let expected = [payload(3), payload(4), "own".into(), payload(3)];
            assert_eq!(neighbors.payloads, expected);
            Ok(())
        })
    }),
    ("Update", |service, uid| {
        Box::pin(async move {
            let request = v1::UpdateRequest {
                payloads: vec![payload(3), "new".into()],
                if_revision: revision(&uid, 1),
                uid,
                ..updating(&[3, 4])
            };
            let answer = service.update(&CALL, request).await?;
            assert_eq!((answer.updated_count, answer.unchanged_count), (1, 1));
            Ok(())
        })
    }),
    ("Write", |service, uid| {
        Box::pin(async move {
            let session = v1::OpenSessionRequest {
                index_name: "arm".into(),
                uid: uid.clone(),
                ..Default::default()
            };
            let session = service.open_session(&CALL, session).await?.session;
            let request = v1::WriteRequest {
                index_name: "arm".into(),
                uid,
                session,
                batch: 1,
                kinds: vec![v1::StepKind::SetTag.into(), v1::StepKind::SetPayload.into()],
                ids: vec![3, 4],
                tags: vec![7, 0],
                payloads: vec!["new".into()],
                ..Default::default()
            };
            assert_eq!(service.write(&CALL, request).await?.missing_count, 0);
            Ok(())
        })
    }),
];

/// Makes a search, which reads nothing from the disk, and, if `writes`, inserts a new point.
async fn answer_others(service: &Service, writes: bool) {
    let answer = service.knn(&CALL, knn(&[[7.9]], 1)).await.unwrap();
    assert_eq!(answer.neighbors.unwrap().ids, [8]);
    if writes {
        let answer = service.insert(&CALL, insertion(&[[100.0]], &[])).await;
        assert_eq!(answer.unwrap().outcomes, [i32::from(v1::Outcome::Inserted)]);
    }
}

#[tokio::test]
async fn other_calls_are_answered_while_one_reads() {
    for (name, reading) in READING {
        println!("{name}");
        let (log, uid) = ten_points().await;
        let service = serving(&log);
        log.gate().close();
        let mut reads = tokio::spawn(reading(service.clone(), uid));
        tokio::select! {
            () = log.gate().holds_a_read() => {}
            ended = &mut reads => panic!("{name} ended without a read: {ended:?}"),
        }
        answer_others(&service, true).await;
        assert!(!reads.is_finished());
        log.gate().open();
        reads.await.unwrap().unwrap();
        answer_others(&service, true).await;
    }
}

/// The log reads the points that it replaces while it holds the writer; searches go on meanwhile.
#[tokio::test]
async fn searches_are_answered_while_the_log_reads_the_points_it_replaces() {
    let (log, _) = ten_points().await;
    let service = serving(&log);
    log.gate().close();
    let removing = service.clone();
    let mut removes = tokio::spawn(async move { removing.remove(&CALL, removal(&[5])).await });
    tokio::select! {
        () = log.gate().holds_a_read() => {}
        ended = &mut removes => panic!("it ended without a read: {ended:?}"),
    }
    answer_others(&service, false).await;
    log.gate().open();
    assert_eq!(removes.await.unwrap().unwrap().removed_count, 1);
}
