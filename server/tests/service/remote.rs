//! Two servers share a journal on another machine. The journal accepts one record of an index at a time, its positions
//! are not revisions, and it loses requests and answers. Each server has its own point store.

mod every_request;
mod latest;
mod refused_records;
mod retries;
mod stream;

use std::{
    collections::BTreeMap,
    future::pending,
    sync::{Arc, atomic::Ordering::Relaxed},
    time::Duration,
};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::time::timeout;
use wayfold_proto::v1;
use wayfold_server::{
    log::{Catalogue, Entry, Journal, Log, MemoryLog, PointStore, RecordPosition, Uid},
    registry::{Registry, RegistryOptions},
    service::{Code, Limits, Service},
};

use crate::support::*;
pub(crate) use stream::{Remote, Stream};

/// A small window makes most catching up read the journal.
const WINDOW_BYTES: usize = 2000;

/// A server over the stream that serves the index of this entry from a point store of its own.
pub(crate) fn server(stream: &Arc<Stream>, entry: &Entry) -> (Service, Arc<Registry>, Arc<Remote>) {
    let points = Arc::new(MemoryLog::new());
    points.create(entry.clone()).unwrap();
    server_over(stream, points, Limits::default())
}

/// A server over the stream with this point store.
fn server_over(
    stream: &Arc<Stream>,
    points: Arc<MemoryLog>,
    limits: Limits,
) -> (Service, Arc<Registry>, Arc<Remote>) {
    let journal = Remote::connect(stream);
    let log = Log {
        journal: Arc::clone(&journal) as Arc<dyn Journal>,
        points: Arc::clone(&points) as Arc<dyn PointStore>,
        catalogue: points,
    };
    let options = RegistryOptions {
        window_bytes: WINDOW_BYTES,
        operations: limits.operations(),
        ..options()
    };
    let registry = Registry::new(log, options);
    registry.replay().unwrap();
    let registry = Arc::new(registry);
    let service = Service::starting(limits);
    service.set_registry(Arc::clone(&registry));
    service.set_ready();
    (service, registry, journal)
}

pub(crate) fn named_arm() -> Entry {
    Entry {
        uid: Uid::unique(),
        name: "arm".into(),
        space: "R1".parse().unwrap(),
        payload_encoding: Default::default(),
    }
}

/// Waits until the service has this revision, and reads all points.
async fn points_at(service: &Service, uid: Uid, number: u64) -> v1::Points {
    let request = v1::GetRequest {
        min_revision: revision(&uid.to_string(), number),
        ..getting(&[])
    };
    service.get(&CALL, request).await.unwrap();
    everything(service).await.points.unwrap()
}

/// Asserts that the records form one chain and that all servers store the points of the records. Returns these points.
pub(crate) async fn settled(stream: &Stream, entry: &Entry, servers: &[&Service]) -> v1::Points {
    let records = stream.records(entry.uid);
    let (mut position, mut expected) = (RecordPosition::START, BTreeMap::new());
    for record in &records {
        assert!(record.follows(position));
        position = record.position();
        for id in record.effects().removed() {
            expected.remove(id).unwrap();
        }
        for point in record.effects().stored().iter() {
            expected.insert(point.id, point.row[0]);
        }
    }
    let found = points_at(servers[0], entry.uid, position.revision).await;
    // A feed has every record, also one whose only effect was to fence another.
    let mut fed = 0;
    while fed < position.revision {
        let request = v1::WatchRequest {
            index_name: entry.name.clone(),
            after_revision: revision(&entry.uid.to_string(), fed),
            include: ALL,
            own_session: 0,
        };
        let answer = servers[0].log(&CALL, request).await.unwrap();
        for mutation in answer.mutations {
            fed += 1;
            assert_eq!(mutation.revision.number(), fed);
        }
    }
    let rows = found.states.clone().unwrap().coordinates;
    let stored: BTreeMap<u64, f64> = found.ids.iter().copied().zip(rows).collect();
    assert_eq!(stored, expected);
    for server in servers {
        assert_eq!(points_at(server, entry.uid, position.revision).await, found);
    }
    found
}

/// Each acknowledged mutation takes effect once. No caller sees a lost message or a refusal.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn servers_that_share_a_journal_agree_and_apply_each_mutation_once() {
    for (seed, loses) in [(1, 0.0), (2, 0.1), (3, 0.3), (4, 0.3)] {
        let (stream, entry) = (Stream::new(seed, loses), named_arm());
        let (one, ..) = server(&stream, &entry);
        let (other, ..) = server(&stream, &entry);
        let writers = (0..6u64).map(|writer| {
            let service = [&one, &other][writer as usize % 2].clone();
            tokio::spawn(async move {
                let mut random = ChaCha8Rng::seed_from_u64(seed << 8 | writer);
                let mut mine = BTreeMap::new();
                for number in 0..40 {
                    let state = 1000.0 * writer as f64 + f64::from(number);
                    if let Some((&id, _)) = mine.first_key_value()
                        && random.random_bool(0.3)
                    {
                        let removed = service.remove(&CALL, removal(&[id])).await.unwrap();
                        assert_eq!(removed.removed_count, 1);
                        mine.remove(&id);
                        continue;
                    }
                    let request = v1::InsertRequest {
                        operation_id: format!("{writer} {number}"),
                        ..insertion(&[[state]], &[])
                    };
                    let first = service.insert(&CALL, request.clone()).await.unwrap();
                    let again = service.insert(&CALL, request).await.unwrap();
                    assert_eq!(first, again);
                    assert_eq!(mine.insert(first.ids[0], state), None);
                }
                mine
            })
        });
        let mut expected = BTreeMap::new();
        for writer in writers.collect::<Vec<_>>() {
            for (id, state) in writer.await.unwrap() {
                assert_eq!(expected.insert(id, state), None, "id {id} was given twice");
            }
        }
        let found = settled(&stream, &entry, &[&one, &other]).await;
        let rows = found.states.unwrap().coordinates;
        let found: BTreeMap<u64, f64> = found.ids.into_iter().zip(rows).collect();
        assert_eq!(found, expected);
    }
}

/// A refused row is evaluated again against the record that took its place.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_two_points_are_too_close_across_servers() {
    let (stream, entry) = (Stream::new(5, 0.2), named_arm());
    let (one, ..) = server(&stream, &entry);
    let (other, ..) = server(&stream, &entry);
    let writers = (0..8u64).map(|writer| {
        let service = [&one, &other][writer as usize % 2].clone();
        tokio::spawn(async move {
            let mut random = ChaCha8Rng::seed_from_u64(writer);
            for _ in 0..30 {
                let request = v1::InsertRequest {
                    min_separation: 0.5,
                    ..insertion(&[[random.random_range(0.0..20.0)]], &[])
                };
                service.insert(&CALL, request).await.unwrap();
            }
        })
    });
    for writer in writers.collect::<Vec<_>>() {
        writer.await.unwrap();
    }
    let found = settled(&stream, &entry, &[&one, &other]).await;
    let mut rows = found.states.unwrap().coordinates;
    rows.sort_by(f64::total_cmp);
    assert!(rows.len() > 10);
    assert!(rows.array_windows().all(|[a, b]| b - a >= 0.5), "{rows:?}");
}

/// The journal is elsewhere, and so are the records that its followers may ask for.
#[tokio::test]
async fn a_point_store_forgets_old_records_and_operations() {
    let (stream, entry) = (Stream::new(9, 0.0), named_arm());
    let points = Arc::new(MemoryLog::new());
    points.create(entry.clone()).unwrap();
    let limits = Limits {
        max_operations: 5,
        ..Limits::default()
    };
    let (service, ..) = server_over(&stream, Arc::clone(&points), limits.clone());
    // It evaluates none of the mutations.
    let followed = Arc::new(MemoryLog::new());
    followed.create(entry.clone()).unwrap();
    let (follower, ..) = server_over(&stream, Arc::clone(&followed), limits);
    for number in 0..100 {
        let request = v1::InsertRequest {
            operation_id: number.to_string(),
            ..insertion(&[[f64::from(number)]], &[])
        };
        service.insert(&CALL, request).await.unwrap();
        let records = points.read(entry.uid, None, usize::MAX).unwrap();
        let bytes = records.iter().map(|record| record.effects().bytes());
        assert!(bytes.sum::<usize>() <= WINDOW_BYTES);
        assert!(points.operations(entry.uid).unwrap().len() <= 5);
    }
    settled(&stream, &entry, &[&service, &follower]).await;
    assert!(followed.operations(entry.uid).unwrap().len() <= 5);
}

/// Inserts a state once the index is available again; returns the revision.
async fn inserted_at_last(service: &Service, state: f64) -> u64 {
    for _ in 0..100 {
        if let Ok(inserted) = service.insert(&CALL, insertion(&[[state]], &[])).await {
            return inserted.revision.number();
        }
        // The clock stops while maintenance resumes the index on a blocking thread.
        let second = Duration::from_secs(1);
        assert!(timeout(second, pending::<()>()).await.is_err());
    }
    panic!("the index stays unavailable");
}

/// The clock jumps ahead whenever no task can run.
#[tokio::test(start_paused = true)]
async fn a_record_that_took_the_place_of_another_arrives_in_time_or_the_index_is_unavailable() {
    let (stream, entry) = (Stream::new(8, 0.0), named_arm());
    let (one, ..) = server(&stream, &entry);
    let (other, registry, journal) = server(&stream, &entry);
    let maintaining = tokio::spawn(registry.maintain(|| ()));
    journal.fall_behind();
    one.insert(&CALL, insertion(&[[1.0]], &[])).await.unwrap();
    let error = other
        .insert(&CALL, insertion(&[[2.0]], &[]))
        .await
        .unwrap_err();
    let reported = (error.code(), error.reason());
    assert_eq!(reported, (Code::Unavailable, "STORAGE_FAILED"));
    assert!(error.to_string().contains("does not send it"), "{error}");
    journal.come_back();
    assert_eq!(inserted_at_last(&other, 3.0).await, 2);
    let found = settled(&stream, &entry, &[&one, &other]).await;
    assert_eq!(found.states.unwrap().coordinates, [1.0, 3.0]);
    maintaining.abort();
}

/// The clock jumps ahead whenever no task can run.
#[tokio::test(start_paused = true)]
async fn an_unsettled_mutation_makes_the_index_unavailable_until_the_journal_answers() {
    let (stream, entry) = (Stream::new(7, 0.0), named_arm());
    let (service, registry, _) = server(&stream, &entry);
    let maintaining = tokio::spawn(registry.maintain(|| ()));
    let insert = |state: f64| {
        let (service, request) = (service.clone(), insertion(&[[state]], &[]));
        async move { service.insert(&CALL, request).await }
    };
    assert_eq!(insert(1.0).await.unwrap().revision.number(), 1);
    stream.is_cut.store(true, Relaxed);
    let error = insert(2.0).await.unwrap_err();
    let reported = (error.code(), error.reason());
    assert_eq!(reported, (Code::Unavailable, "STORAGE_FAILED"));
    assert!(error.to_string().contains("operation_id"), "{error}");
    assert_eq!(everything(&service).await.point_count, 1);
    stream.is_cut.store(false, Relaxed);
    assert_eq!(inserted_at_last(&service, 3.0).await, 2);
    let found = settled(&stream, &entry, &[&service]).await;
    assert_eq!(found.states.unwrap().coordinates, [1.0, 3.0]);
    maintaining.abort();
}

/// The server stops writing and serves what it has applied.
#[tokio::test]
async fn a_journal_that_has_lost_applied_records_is_noticed() {
    let (stream, entry) = (Stream::new(10, 0.0), named_arm());
    let (service, ..) = server(&stream, &entry);
    for state in [1.0, 2.0, 3.0] {
        let inserted = service.insert(&CALL, insertion(&[[state]], &[])).await;
        inserted.unwrap();
    }
    stream.lose_after(entry.uid, 2);
    for _ in 0..2 {
        let error = service.insert(&CALL, insertion(&[[4.0]], &[])).await;
        let error = error.unwrap_err();
        // Clients take no other code for one that passes, and leave the server.
        assert_eq!(error.code(), Code::Unavailable, "{error}");
        assert!(error.to_string().contains("has applied 3"), "{error}");
    }
    assert_eq!(everything(&service).await.point_count, 3);
    let listing = service
        .list_indexes(&CALL, Default::default())
        .await
        .unwrap();
    assert!(listing.indexes.is_empty());
    let damaged = &listing.damaged[0];
    assert_eq!(
        (&*damaged.name, damaged.error.code()),
        ("arm", Code::Unavailable)
    );
}

/// A mutation may be right by records that its server lacks: the server refuses it only once no record can come before the
/// refusal.
#[tokio::test]
async fn no_mutation_is_refused_for_what_another_server_has_changed() {
    let (stream, entry) = (Stream::new(13, 0.0), named_arm());
    let (one, ..) = server(&stream, &entry);
    let (other, _, behind) = server(&stream, &entry);
    one.insert(&CALL, insertion(&[[7.0]], &[7])).await.unwrap();
    insert_rows(&other, &[[8.0]], &[8]).await;
    behind.fall_behind();
    one.remove(&CALL, removal(&[7])).await.unwrap();
    one.insert(&CALL, insertion(&[[9.0]], &[9])).await.unwrap();
    let mut inserted = Box::pin(other.insert(&CALL, insertion(&[[7.5]], &[7])));
    let mut updated = Box::pin(other.update(
        &CALL,
        v1::UpdateRequest {
            tags: vec![1],
            ..updating(&[9])
        },
    ));
    assert!(futures_util::poll!(inserted.as_mut()).is_pending());
    assert!(futures_util::poll!(updated.as_mut()).is_pending());
    behind.come_back();
    let (inserted, updated) = tokio::join!(inserted, updated);
    inserted.unwrap();
    assert_eq!(updated.unwrap().updated_count, 1);
    let twice = other.insert(&CALL, insertion(&[[7.0]], &[7])).await;
    assert_eq!(twice.unwrap_err().reason(), "POINTS_EXIST");
    settled(&stream, &entry, &[&one, &other]).await;
}

/// A server that lags has the point that another one has removed: it answers neither that it is stored as it is, nor that
/// another is too close to it.
#[tokio::test]
async fn no_answer_without_effect_is_from_the_past() {
    let (stream, entry) = (Stream::new(14, 0.0), named_arm());
    let (one, ..) = server(&stream, &entry);
    let (other, _, behind) = server(&stream, &entry);
    let stored = insertion(&[[7.0]], &[7]);
    let close = v1::InsertRequest {
        min_separation: 0.5,
        ..insertion(&[[7.1]], &[8])
    };
    for again in [stored.clone(), close] {
        one.insert(&CALL, stored.clone()).await.unwrap();
        let kept = other.insert(&CALL, again.clone()).await.unwrap();
        assert_eq!(kept.ids, [7]);
        behind.fall_behind();
        one.remove(&CALL, removal(&[7])).await.unwrap();
        let mut inserted = Box::pin(other.insert(&CALL, again));
        assert!(futures_util::poll!(inserted.as_mut()).is_pending());
        behind.come_back();
        let inserted = inserted.await.unwrap();
        assert_eq!(inserted.outcomes, [i32::from(v1::Outcome::Inserted)]);
        other.remove(&CALL, removal(&inserted.ids)).await.unwrap();
    }
    settled(&stream, &entry, &[&one, &other]).await;
}
