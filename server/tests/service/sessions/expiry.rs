//! Sessions that are idle for too long end when another one is opened.

use std::{sync::Arc, time::Duration};

use wayfold_server::{
    log::{Catalogue, Effects, Journal, MemoryLog, Record, RecordPosition},
    service::Limits,
};

use super::*;

const ENDED: (Code, &str) = (Code::FailedPrecondition, "SESSION_ENDED");

/// A log with the same mutations, made earlier by this much.
fn aged(log: &MemoryLog, by: Duration) -> Arc<MemoryLog> {
    let aged = Arc::new(MemoryLog::new());
    for entry in log.indexes().unwrap() {
        aged.create(entry.clone()).unwrap();
        let mut position = RecordPosition::START;
        for record in log.read(entry.uid, None, usize::MAX).unwrap() {
            let time_ms = record.time_ms() - by.as_millis() as u64;
            let effects = Effects::clone(record.effects());
            let record = Record::new(record.revision(), position.digest, time_ms, effects);
            position = record.position();
            let submitted = aged.submit(entry.uid, Arc::new(record));
            assert!(submitted.is_ok());
        }
    }
    aged
}

fn idle(seconds: u64) -> Limits {
    Limits {
        max_session_idle_seconds: seconds,
        max_sessions: 2,
        ..Limits::default()
    }
}

#[tokio::test]
async fn an_idle_session_ends_and_its_late_retry_brings_nothing_back() {
    let log = Arc::new(MemoryLog::new());
    let service = service_with(Arc::clone(&log), idle(100));
    let uid = create(&service, "arm", "R1").await;
    let (session, opened) = open(&service, &uid, 3).await;
    assert_eq!(opened.idle_seconds, 100);
    let newest = batch(&session, 1, &[Put(session.first, 0.5)]);
    let response = write(&service, newest.clone()).await;
    service
        .remove(&CALL, removal(&[session.first]))
        .await
        .unwrap();

    let log = aged(&log, Duration::from_secs(101));
    let service = restarted_with(Arc::clone(&log), options(), idle(100));
    // It ends only when another session is opened, and until then its retry is recognised.
    assert_eq!(write(&service, newest.clone()).await, response);
    let (other, _) = open(&service, &uid, 0).await;
    let services = [
        service.clone(),
        restarted_with(Arc::clone(&log), options(), idle(100)),
    ];
    for service in &services {
        let next = batch(&session, 2, &[Put(session.first, 0.5)]);
        for late in [newest.clone(), next] {
            assert_eq!(refused_batch(service, late).await, ENDED);
        }
        assert_eq!(stored(service).await, [] as [u64; 0]);
    }
    // Its ids are free for all, and the server assigns none of them.
    write(&service, batch(&other, 1, &[Put(session.first, 0.5)])).await;
    let own = insertion(&[[0.6]], &[session.first + 1]);
    service.insert(&CALL, own).await.unwrap();
    let assigned = service.insert(&CALL, insertion(&[[0.7]], &[])).await;
    assert_eq!(assigned.unwrap().ids, [session.first + 3]);
}

#[tokio::test]
async fn a_batch_keeps_its_session_and_a_retry_does_not() {
    for writes in [false, true] {
        let log = Arc::new(MemoryLog::new());
        let service = service_with(Arc::clone(&log), idle(100));
        let uid = create(&service, "arm", "R1").await;
        let (session, _) = open(&service, &uid, 1).await;
        let first = batch(&session, 1, &[Put(session.first, 0.5)]);
        write(&service, first.clone()).await;

        let log = aged(&log, Duration::from_secs(101));
        let service = restarted_with(Arc::clone(&log), options(), idle(100));
        write(&service, first).await;
        if writes {
            write(&service, batch(&session, 2, &[])).await;
        }
        open(&service, &uid, 0).await;
        let next = batch(&session, 2 + u64::from(writes), &[]);
        match writes {
            true => drop(write(&service, next).await),
            false => assert_eq!(refused_batch(&service, next).await, ENDED),
        }
    }
}

/// The limit is not reached: the session's last record is 99 seconds old and a few milliseconds.
#[tokio::test]
async fn a_session_lives_for_the_whole_limit_and_full_places_are_freed() {
    let log = Arc::new(MemoryLog::new());
    let service = service_with(Arc::clone(&log), idle(100));
    let uid = create(&service, "arm", "R1").await;
    let (session, _) = open(&service, &uid, 0).await;
    open(&service, &uid, 0).await;
    let full = (Code::ResourceExhausted, "LIMIT_EXCEEDED");
    let refused = |answer| {
        let (code, reason, _) = refusal::<v1::OpenSessionResponse>(answer);
        (code, reason)
    };
    assert_eq!(refused(service.open_session(&CALL, opening(0)).await), full);

    let log = aged(&log, Duration::from_secs(200));
    let service = restarted_with(Arc::clone(&log), options(), idle(100_000));
    assert_eq!(refused(service.open_session(&CALL, opening(0)).await), full);
    write(&service, batch(&session, 1, &[])).await;
    // One place is free: the other session has ended.
    let service = restarted_with(log, options(), idle(100));
    open(&service, &uid, 0).await;
    assert_eq!(refused(service.open_session(&CALL, opening(0)).await), full);
    write(&service, batch(&session, 2, &[])).await;
}

/// A writer could take all places for the idle time otherwise.
#[tokio::test]
async fn the_oldest_session_without_a_batch_makes_room_after_ten_minutes() {
    let limits = Limits {
        max_sessions: 3,
        ..idle(100_000)
    };
    let log = Arc::new(MemoryLog::new());
    let service = service_with(Arc::clone(&log), limits.clone());
    let uid = create(&service, "arm", "R1").await;
    let (writing, _) = open(&service, &uid, 0).await;
    write(&service, batch(&writing, 1, &[])).await;
    let (oldest, _) = open(&service, &uid, 2).await;
    let (other, _) = open(&service, &uid, 0).await;

    let full = (Code::ResourceExhausted, "LIMIT_EXCEEDED");
    for (age, places) in [(590, 0), (601, 2)] {
        let aged = aged(&log, Duration::from_secs(age));
        let service = restarted_with(aged, options(), limits.clone());
        for _ in 0..places {
            open(&service, &uid, 0).await;
        }
        let (code, reason, _) = refusal(service.open_session(&CALL, opening(0)).await);
        assert_eq!((code, reason), full);
        write(&service, batch(&writing, 2, &[])).await;
        for (session, place) in [(&oldest, 1), (&other, 2)] {
            let late = service.write(&CALL, batch(session, 1, &[])).await;
            assert_eq!(late.is_err(), places >= place, "{late:?}");
        }
    }
}

/// Limits that no clock reaches.
#[tokio::test]
async fn sessions_with_an_endless_limit_never_end() {
    for seconds in [1 << 40, i64::MAX as u64, u64::MAX] {
        let log = Arc::new(MemoryLog::new());
        let service = service_with(Arc::clone(&log), idle(seconds));
        let uid = create(&service, "arm", "R1").await;
        let (session, opened) = open(&service, &uid, 0).await;
        assert_eq!(opened.idle_seconds, seconds);
        let log = aged(&log, Duration::from_secs(1_000_000_000));
        let service = restarted_with(log, options(), idle(seconds));
        open(&service, &uid, 0).await;
        write(&service, batch(&session, 1, &[])).await;
    }
}
