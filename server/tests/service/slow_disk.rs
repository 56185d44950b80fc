//! A slow disk delays only the calls that read from it: other calls are answered, on a single thread and on one index.

use std::sync::Arc;

use futures_util::{
    future::{BoxFuture, join_all},
    poll,
};
use wayfold_proto::v1;
use wayfold_server::{
    registry::RegistryOptions,
    service::{Error, Limits, Service},
};

use crate::{fault::FaultLog, support::*};

/// Serves the content of the log with empty caches.
fn serving(log: &FaultLog) -> Service {
    restarted_with(Arc::new(log.clone()), options(), Limits::default())
}

/// Serves the content of the log, with a cache of records that holds less than one record.
fn serving_without_cache(log: &FaultLog, limits: Limits) -> Service {
    let options = RegistryOptions {
        window_bytes: 1,
        ..options()
    };
    restarted_with(Arc::new(log.clone()), options, limits)
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
        payloads: true,
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
const READING: [(&str, Reading); 10] = [
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
            let request = v1::WatchRequest {
                index_name: "arm".into(),
                after_revision: revision(&uid, 0),
                include: ALL,
                own_session: 0,
            };
            let mut watch = service.watch(&CALL, request).await?;
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
                neighbors: neighbor_payloads(2),
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
                index_name: "arm".into(),
                ids: vec![3, 4],
                payloads: vec![payload(3), "new".into()],
                if_revision: revision(&uid, 1),
                uid,
                ..Default::default()
            };
            let answer = service.update(&CALL, request).await?;
            assert_eq!((answer.updated_count, answer.unchanged_count), (1, 1));
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

/// Begins a call and makes a change once the call has begun to read the stored points. Returns the call's outcome.
async fn overtaken<T>(
    call: impl AsyncFnOnce(Service) -> Result<T, Error>,
    change: impl AsyncFnOnce(Service),
) -> (Service, Result<T, Error>) {
    let (log, _) = ten_points().await;
    let service = serving(&log);
    log.gate().close();
    let mut call = Box::pin(call(service.clone()));
    assert!(poll!(&mut call).is_pending());
    log.gate().holds_a_read().await;
    log.gate().open();
    change(service.clone()).await;
    (service, call.await)
}

fn update(tags: &[u64], payloads: &[&'static str]) -> v1::UpdateRequest {
    v1::UpdateRequest {
        index_name: "arm".into(),
        ids: vec![3],
        tags: tags.into(),
        payloads: payloads.iter().map(|payload| (*payload).into()).collect(),
        ..Default::default()
    }
}

async fn change_three(service: Service) {
    let changed = service.update(&CALL, update(&[], &["changed"])).await;
    assert_eq!(changed.unwrap().updated_count, 1);
}

async fn remove_three(service: Service) {
    let removed = service.remove(&CALL, removal(&[3])).await;
    assert_eq!(removed.unwrap().removed_count, 1);
}

/// A mutation that read points before it had the writer uses their newest content.
#[tokio::test]
async fn a_mutation_sees_what_changed_while_it_read() {
    let again = async |service: Service| service.insert(&CALL, first_points(4)).await;
    let (_, refused) = overtaken(again, change_three).await;
    assert!(matches!(refused, Err(Error::PointsExist { ids, .. }) if ids == [3]));
    let (_, inserted) = overtaken(again, remove_three).await;
    let [unchanged, inserted_again] =
        [v1::Outcome::Unchanged, v1::Outcome::Inserted].map(i32::from);
    let outcomes = [unchanged, unchanged, unchanged, inserted_again];
    assert_eq!(inserted.unwrap().outcomes, outcomes);

    let tag = async |service: Service| service.update(&CALL, update(&[7], &[])).await;
    let (service, tagged) = overtaken(tag, change_three).await;
    assert_eq!(tagged.unwrap().updated_count, 1);
    let points = service.get(&CALL, getting(&[3])).await.unwrap().points;
    let points = points.unwrap();
    assert_eq!((&*points.payloads[0], points.tags[0]), (&b"changed"[..], 7));
    let (_, missing) = overtaken(tag, remove_three).await;
    assert!(matches!(missing, Err(Error::PointsNotFound { ids, .. }) if ids == [3]));
    let compare = async |service: Service| {
        let uid = info(&service, "arm").await.revision.uid();
        let request = v1::UpdateRequest {
            if_revision: revision(&uid, 1),
            uid,
            ..update(&[7], &[])
        };
        service.update(&CALL, request).await
    };
    let (_, conflict) = overtaken(compare, change_three).await;
    assert!(matches!(conflict, Err(Error::RevisionConflict { ids, .. }) if ids == [3]));
}

/// The neighbours include points that were inserted after the call began, and points that are near only after a
/// removal.
#[tokio::test]
async fn an_insert_answers_with_the_payloads_of_its_final_neighbours() {
    let insert = async |service: Service| {
        let request = v1::InsertRequest {
            neighbors: neighbor_payloads(2),
            ..insertion(&[[3.1]], &[])
        };
        let neighbors = service.insert(&CALL, request).await?.neighbors.unwrap();
        Ok((neighbors.ids, neighbors.payloads))
    };
    let answer = overtaken(insert, change_three).await.1.unwrap();
    assert_eq!(answer, (vec![3, 4], vec!["changed".into(), payload(4)]));
    let answer = overtaken(insert, remove_three).await.1.unwrap();
    assert_eq!(answer, (vec![4, 2], vec![payload(4), payload(2)]));
    let add = async |service: Service| {
        let request = v1::InsertRequest {
            payloads: vec!["near".into()],
            ..insertion(&[[3.2]], &[50])
        };
        service.insert(&CALL, request).await.unwrap();
    };
    let answer = overtaken(insert, add).await.1.unwrap();
    assert_eq!(answer, (vec![3, 50], vec![payload(3), "near".into()]));
}

/// The update ends although other writers commit more than the cache of records holds during each read.
#[tokio::test]
async fn an_update_that_others_overtake_again_and_again_ends() {
    let (log, _) = ten_points().await;
    let service = serving_without_cache(&log, Limits::default());
    let updating = service.clone();
    let update =
        tokio::spawn(async move { updating.update(&CALL, update(&[], &["changed"])).await });
    let mut overtaken = 0;
    while !update.is_finished() {
        let others = [[100.0], [101.0]].map(async |row| {
            let inserted = service.insert(&CALL, insertion(&[row], &[])).await;
            inserted.unwrap();
        });
        join_all(others).await;
        overtaken += 1;
        assert!(overtaken < 5_000, "the update starves");
    }
    assert_eq!(update.await.unwrap().unwrap().updated_count, 1);
}

/// An insert's answer lacks the payloads that the insert replaces, although its rows found them before the comparison.
#[tokio::test]
async fn an_overtaken_insert_is_not_charged_for_the_payloads_that_it_replaces() {
    let log = FaultLog::new(0);
    let limits = Limits {
        max_answer_bytes: 2000,
        ..Limits::default()
    };
    let service = serving_without_cache(&log, limits);
    create(&service, "arm", "R1").await;
    let pair = |payload: &'static [u8]| v1::InsertRequest {
        payloads: vec![payload.into(); 2],
        ..insertion(&[[3.0], [4.0]], &[3, 4])
    };
    let large = &[7; 1500];
    service.insert(&CALL, pair(large)).await.unwrap();

    log.gate().close();
    let request = v1::InsertRequest {
        on_conflict: v1::OnConflict::Replace.into(),
        neighbors: neighbor_payloads(1),
        ..pair(b"small")
    };
    let mut inserting = Box::pin(service.insert(&CALL, request));
    assert!(poll!(&mut inserting).is_pending());
    log.gate().holds_a_read().await;
    log.gate().open();
    // The cache of records holds less than this, so the insert reads again.
    for x in [100.0, 101.0] {
        service.insert(&CALL, insertion(&[[x]], &[])).await.unwrap();
    }
    let neighbors = inserting.await.unwrap().neighbors.unwrap();
    assert_eq!(neighbors.ids, [4, 3]);
    assert_eq!(neighbors.payloads, [&large[..], b"small"]);
}
