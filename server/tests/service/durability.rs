//! A revision is seen, and a mutation acknowledged, only once the log is synced; a log that fails stops its index.

use std::{
    pin::pin,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    task::{Context, Wake, Waker},
    thread::ThreadId,
    time::Duration,
};

use futures_util::{StreamExt, poll, stream};
use tokio::{
    sync::{Notify, watch},
    time::timeout,
};
use wayfold_proto::v1;
use wayfold_server::{
    log::{
        Catalogue, Journal, LogError, MemoryLog, PointStore, Receipt, Record, RecordStream, Uid,
        View,
    },
    service::{Code, Limits},
};

use crate::{
    forward::{forward_catalogue, forward_journal, forward_points},
    support::*,
};

/// A log in memory whose syncs and failures the test controls.
struct ControlledLog {
    memory: MemoryLog,
    synced: watch::Sender<u64>,
    fails: Arc<AtomicBool>,
    /// True while its points take no records.
    is_full: AtomicBool,
    /// The thread that last appended to it.
    appended_by: Mutex<Option<ThreadId>>,
}

impl ControlledLog {
    fn new() -> Arc<Self> {
        Arc::new(Self {
            memory: MemoryLog::new(),
            synced: watch::Sender::new(0),
            fails: Arc::default(),
            is_full: AtomicBool::new(false),
            appended_by: Mutex::new(None),
        })
    }
}

forward_catalogue!(ControlledLog, memory);

impl Journal for ControlledLog {
    forward_journal!(memory);

    fn submit(&self, uid: Uid, record: Arc<Record>) -> Result<Receipt, LogError> {
        *self.appended_by.lock().unwrap() = Some(std::thread::current().id());
        self.memory.submit(uid, record)
    }

    fn follow(&self, uid: Uid, after: u64) -> RecordStream {
        let (fails, synced) = (Arc::clone(&self.fails), self.synced.subscribe());
        let records = self.memory.follow(uid, after);
        let single = records.flat_map(|batch| stream::iter(batch.unwrap()));
        let held = single.then(move |record| {
            let (fails, mut synced) = (Arc::clone(&fails), synced.clone());
            async move {
                let revision = record.revision();
                if fails.load(Ordering::Relaxed) {
                    return Err(LogError::damaged_record(uid, revision, "the disk is full"));
                }
                let reached = synced.wait_for(|&synced| synced >= revision).await;
                reached.unwrap();
                Ok(vec![record])
            }
        });
        held.boxed()
    }
}

impl PointStore for ControlledLog {
    forward_points!(memory);

    fn apply(&self, uid: Uid, records: &[Arc<Record>]) -> Result<Arc<dyn View>, LogError> {
        if self.is_full.load(Ordering::Relaxed) {
            let what = "no space left".into();
            return Err(LogError::Storage { what });
        }
        self.memory.apply(uid, records)
    }

    fn view(&self, uid: Uid) -> Result<Arc<dyn View>, LogError> {
        self.memory.view(uid)
    }
}

#[tokio::test]
async fn readers_and_callers_wait_for_the_sync_and_the_writer_does_not() {
    let log = ControlledLog::new();
    let service = service_with(log.clone(), Limits::default());
    create(&service, "arm", "R1").await;
    let mut first = pin!(service.insert(&CALL, insertion(&[[1.0]], &[])));
    assert!(poll!(&mut first).is_pending());
    let request = v1::InsertRequest {
        neighbor_spec: Some(v1::NeighborSpec {
            k_form: nearest(9),
            ..Default::default()
        }),
        ..insertion(&[[2.0]], &[])
    };
    let mut second = pin!(service.insert(&CALL, request));
    assert!(poll!(&mut second).is_pending());
    assert_eq!(everything(&service).await.point_count, 0);

    log.synced.send_replace(1);
    assert_eq!(first.await.unwrap().revision.number(), 1);
    assert!(poll!(&mut second).is_pending());
    assert_eq!(everything(&service).await.points.unwrap().ids, [0]);

    log.synced.send_replace(2);
    let response = second.await.unwrap();
    // The insert was evaluated against the writer's unpublished head.
    assert_eq!(
        (response.revision.number(), response.neighbors.unwrap().ids),
        (2, vec![0])
    );
    assert_eq!(everything(&service).await.points.unwrap().ids, [0, 1]);
}

#[tokio::test]
async fn a_call_dropped_after_it_was_logged_takes_place() {
    // The larger mutation is committed on a thread of its own.
    for rows in [1, 5000] {
        let log = ControlledLog::new();
        let service = service_with(log.clone(), Limits::default());
        let uid = create(&service, "arm", "R3").await;
        let entry = log.indexes().unwrap().remove(0);
        let request = insertion(&cube(1, rows), &[]);
        {
            let mut dropped = pin!(service.insert(&CALL, request));
            while log.view(entry.uid).unwrap().revision() == 0 {
                assert!(poll!(&mut dropped).is_pending());
                tokio::task::yield_now().await;
            }
        }
        log.synced.send_replace(1);
        let request = v1::GetRequest {
            min_revision: revision(&uid, 1),
            ..getting(&[rows as u64 - 1])
        };
        assert_eq!(
            service.get(&CALL, request).await.unwrap().revision.number(),
            1
        );
    }
}

#[tokio::test]
async fn a_retry_is_not_acknowledged_before_the_original_is_durable() {
    let log = ControlledLog::new();
    let service = service_with(log.clone(), Limits::default());
    create(&service, "arm", "R1").await;
    let request = v1::InsertRequest {
        operation_id: "op".into(),
        ..insertion(&[[1.0]], &[])
    };
    let mut original = pin!(service.insert(&CALL, request.clone()));
    let mut retry = pin!(service.insert(&CALL, request));
    assert!(poll!(&mut original).is_pending());
    assert!(poll!(&mut retry).is_pending());
    log.synced.send_replace(1);
    assert_eq!(retry.await.unwrap(), original.await.unwrap());
}

/// Signals each wake-up of the polled future.
#[derive(Default)]
struct WakeSignal(Notify);

impl Wake for WakeSignal {
    fn wake(self: Arc<Self>) {
        self.0.notify_one();
    }
}

/// The paused clock advances only while no task can run.
#[tokio::test(start_paused = true)]
async fn calls_that_write_nothing_wait_for_the_sync_without_the_writer() {
    let log = ControlledLog::new();
    let service = service_with(log.clone(), Limits::default());
    create(&service, "arm", "R1").await;
    let entry = log.indexes().unwrap().remove(0);
    let original = v1::InsertRequest {
        operation_id: "op".into(),
        ..insertion(&[[1.0]], &[1])
    };
    let unchanged = v1::InsertRequest {
        operation_id: "unchanged".into(),
        ..insertion(&[[1.0]], &[1])
    };
    let requests = [
        (original.clone(), 1),
        (original, 1),
        (unchanged.clone(), 1),
        (unchanged, 1),
        (insertion(&[[2.0]], &[2]), 2),
    ];
    let mut calls = Vec::new();
    for (request, logged) in requests {
        let mut call = Box::pin(service.insert(&CALL, request));
        let woken = Arc::new(WakeSignal::default());
        let waker = Waker::from(Arc::clone(&woken));
        let mut context = Context::from_waker(&waker);
        assert!(call.as_mut().poll(&mut context).is_pending());
        // The call yields and reads stored points on another thread; then it waits for the sync.
        while timeout(Duration::from_secs(1), woken.0.notified())
            .await
            .is_ok()
        {
            assert!(call.as_mut().poll(&mut context).is_pending());
        }
        assert_eq!(log.view(entry.uid).unwrap().revision(), logged);
        calls.push(call);
    }
    log.synced.send_replace(1);
    let mut responses = Vec::new();
    for call in &mut calls[..4] {
        responses.push(call.await.unwrap());
    }
    assert_eq!(responses[0], responses[1]);
    assert_eq!(responses[2], responses[3]);
    assert!(
        responses
            .iter()
            .all(|response| response.revision.number() == 1)
    );
}

#[tokio::test]
async fn mutations_with_many_rows_or_bytes_are_logged_on_another_thread() {
    let log = ControlledLog::new();
    log.synced.send_replace(9);
    let service = service_with(log.clone(), Limits::default());
    create(&service, "arm", "R3").await;
    let with_payload = |bytes: usize| v1::InsertRequest {
        payloads: vec![vec![1; bytes].into(); 3],
        ..insertion(&cube(1, 3), &[])
    };
    for (request, elsewhere) in [
        (insertion(&cube(1, 1000), &[]), false),
        (insertion(&cube(1, 5000), &[]), true),
        (with_payload(1024), false),
        (with_payload(64 * 1024), true),
    ] {
        service.insert(&CALL, request).await.unwrap();
        let caller = std::thread::current().id();
        assert_eq!(*log.appended_by.lock().unwrap() != Some(caller), elsewhere);
    }
}

#[tokio::test]
async fn an_index_whose_log_fails_takes_no_more_and_still_answers() {
    let log = ControlledLog::new();
    let service = service_with(log.clone(), Limits::default());
    create(&service, "arm", "R1").await;
    log.synced.send_replace(1);
    insert_rows(&service, &[[1.0]], &[]).await;
    log.fails.store(true, Ordering::Relaxed);
    for _ in 0..2 {
        let answer = service.insert(&CALL, insertion(&[[2.0]], &[])).await;
        assert_eq!(refusal(answer).0, Code::DataLoss);
        // The index stays stopped after one failure of the log.
        log.fails.store(false, Ordering::Relaxed);
        log.synced.send_replace(9);
    }
    assert_eq!(everything(&service).await.points.unwrap().ids, [0]);
}

/// The record of the mutation is in the journal: it was no bug of the server.
#[tokio::test]
async fn a_mutation_whose_record_cannot_be_applied_says_that_the_store_failed() {
    let log = ControlledLog::new();
    let service = service_with(log.clone(), Limits::default());
    create(&service, "arm", "R1").await;
    log.synced.send_replace(9);
    log.is_full.store(true, Ordering::Relaxed);
    for _ in 0..2 {
        let answer = service.insert(&CALL, insertion(&[[1.0]], &[])).await;
        let error = answer.unwrap_err();
        assert_eq!(error.code(), Code::Unavailable, "{error}");
        assert!(error.to_string().contains("no space left"), "{error}");
    }
}
