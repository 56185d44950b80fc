//! The log is the only source of state: a second server over the same log equals the first.

use std::sync::Arc;

use wayfold_proto::v1;
use wayfold_server::{
    log::{Durability, FjallLog, Log, LogError, MemoryLog, PointStore, Record, Uid, View},
    registry::{Registry, RegistryOptions},
    service::{Code, Limits, Service},
};

use crate::{
    forward::{forward_catalogue, forward_points, forward_whole_journal},
    support::*,
};

/// The log refuses the later of two records at once, and its server evaluates that call again.
#[tokio::test]
async fn two_servers_over_one_log_insert_at_a_time() {
    let log = Log::from(Arc::new(MemoryLog::new()));
    let one = service_with(log.clone(), Limits::default());
    let uid = create(&one, "arm", "R1").await;
    let two = restarted(log);
    for first in (0..20).step_by(2) {
        let call = insertion(&[[0.5]], &[]);
        let (a, b) = tokio::join!(one.insert(&CALL, call.clone()), two.insert(&CALL, call));
        let mut ids = [a.unwrap().ids, b.unwrap().ids].concat();
        ids.sort();
        assert_eq!(ids, [first, first + 1]);
    }
    for service in [&one, &two] {
        let last = v1::GetRequest {
            min_revision: revision(&uid, 20),
            ..getting(&[19])
        };
        service.get(&CALL, last).await.unwrap();
    }
    assert_eq!(everything(&one).await, everything(&two).await);
}

/// A log that finds every index damaged at its second revision.
struct DamagedLog(MemoryLog);

forward_catalogue!(DamagedLog, 0);
forward_whole_journal!(DamagedLog, 0);

impl PointStore for DamagedLog {
    forward_points!(0);

    fn apply(&self, uid: Uid, records: &[Arc<Record>]) -> Result<Arc<dyn View>, LogError> {
        readable(uid, self.0.apply(uid, records)?)
    }

    fn view(&self, uid: Uid) -> Result<Arc<dyn View>, LogError> {
        readable(uid, self.0.view(uid)?)
    }
}

fn readable(uid: Uid, view: Arc<dyn View>) -> Result<Arc<dyn View>, LogError> {
    match view.revision() == 2 {
        false => Ok(view),
        true => Err(LogError::damaged_record(
            uid,
            2,
            "it does not match its checksum",
        )),
    }
}

/// Makes an index whose second mutation is logged but cannot be applied for readers.
async fn create_damaged(service: &Service, name: &str) -> String {
    let uid = create(service, name, "R1").await;
    for row in [[1.0], [2.0]] {
        let request = v1::InsertRequest {
            index_name: name.into(),
            ..insertion(&[row], &[])
        };
        let inserted = service.insert(&CALL, request).await;
        assert_eq!(inserted.is_ok(), row == [1.0]);
    }
    uid
}

#[tokio::test]
async fn damaged_indices_are_listed_among_the_others_page_by_page() {
    let log = Log::from(Arc::new(DamagedLog(MemoryLog::new())));
    let before = service_with(log.clone(), Limits::default());
    let mut expected = Vec::new();
    for name in ["e", "c", "a", "d", "b"] {
        let uid = match name {
            "b" | "c" | "e" => create_damaged(&before, name).await,
            _ => create(&before, name, "R1").await,
        };
        expected.push((name.to_owned(), uid));
    }
    expected.sort();
    drop(before);
    let registry = Registry::new(log, options());
    registry.replay().unwrap();
    let registry = Arc::new(registry);
    // Some pages end by their size, others by the bytes of the answer.
    for (page_size, max_answer_bytes, longest) in
        [(1, 9999, 1), (2, 9999, 2), (5, 9999, 5), (5, 500, 4)]
    {
        let limits = Limits {
            max_answer_bytes,
            ..Limits::default()
        };
        let service = Service::starting(limits);
        service.set_registry(Arc::clone(&registry));
        service.set_ready();
        let (mut listed, mut most) = (Vec::new(), 0);
        let mut request = v1::ListIndexesRequest {
            page_size,
            ..Default::default()
        };
        loop {
            let page = service.list_indexes(&CALL, request.clone()).await.unwrap();
            let mut names = Vec::new();
            for index in page.indexes {
                names.push((index.name, index.revision.uid()));
            }
            for damaged in page.damaged {
                let get = v1::GetIndexRequest {
                    index_name: damaged.name.clone(),
                };
                let refused = service.get_index(&CALL, get).await.unwrap_err();
                assert_eq!(refused, damaged.error);
                assert_eq!(refused.code(), Code::DataLoss);
                names.push((damaged.name, damaged.uid));
            }
            names.sort();
            most = most.max(names.len());
            listed.append(&mut names);
            if page.next_page_token.is_empty() {
                break;
            }
            request.page_token = page.next_page_token;
        }
        assert_eq!(listed, expected, "pages of {page_size}");
        assert!(most <= longest, "{most} in a page of {page_size}");
    }
}

#[tokio::test]
async fn a_damaged_index_says_so_and_leaves_the_others_alone() {
    let log = Log::from(Arc::new(DamagedLog(MemoryLog::new())));
    let service = service_with(log.clone(), Limits::default());
    create_damaged(&service, "damaged").await;
    create(&service, "other", "R1").await;
    drop(service);
    let service = restarted(log);
    let refused = service
        .knn(
            &CALL,
            v1::KnnRequest {
                index_name: "damaged".into(),
                ..knn(&[[1.0]], 1)
            },
        )
        .await;
    assert_eq!(refusal(refused.clone()).0, Code::DataLoss);
    let error = refused.unwrap_err().to_string();
    assert!(error.contains("record of revision 2"), "{error}");
    let again = service.create_index(&CALL, creation("damaged", "R1")).await;
    assert_eq!(refusal(again).0, Code::DataLoss);
    // The other indices are served, and the damaged one can be deleted and created anew.
    assert_eq!(info(&service, "other").await.point_count, 0);
    delete(&service, "damaged").await;
    create(&service, "damaged", "R1").await;
}

#[tokio::test]
async fn operations_are_remembered_for_their_own_window_without_their_records() {
    let directory = tempfile::tempdir().unwrap();
    let on_disk = FjallLog::open(directory.path(), Durability::Fsync).unwrap();
    for log in [
        Log::from(Arc::new(on_disk)),
        Log::from(Arc::new(MemoryLog::new())),
    ] {
        let options = RegistryOptions {
            window_bytes: 0,
            ..options()
        };
        let limits = Limits {
            max_operations: 5,
            ..Limits::default()
        };
        let restart = |log: &Log| restarted_with(log.clone(), options, limits.clone());
        let before = restart(&log);
        create(&before, "arm", "R1").await;
        let request = |at: u64| v1::InsertRequest {
            operation_id: format!("op {at}"),
            ..insertion(&[[at as f64]], &[])
        };
        let mut responses = Vec::new();
        for at in 0..9 {
            responses.push(before.insert(&CALL, request(at)).await.unwrap());
        }
        drop(before);
        let entry = log.catalogue.indexes().unwrap().remove(0);
        assert_eq!(
            log.journal.read(entry.uid, None, usize::MAX).unwrap().len(),
            1
        );
        let after = restart(&log);
        for at in 4..9 {
            let retried = after.insert(&CALL, request(at)).await.unwrap();
            assert_eq!(retried, responses[at as usize]);
        }
        assert_eq!(info(&after, "arm").await.revision.number(), 9);
        // The operation is outside the window, so the retry is a new call.
        assert_eq!(
            after
                .insert(&CALL, request(3))
                .await
                .unwrap()
                .revision
                .number(),
            10
        );
        drop(after);
        let newest = log.points.operations(entry.uid).unwrap().split_off(3);
        let limits = Limits {
            max_operation_bytes: newest.iter().map(|operation| operation.bytes()).sum(),
            ..Limits::default()
        };
        let after = restarted_with(log, options, limits);
        for (at, revision) in [(8, 9), (7, 11)] {
            let retried = after.insert(&CALL, request(at)).await.unwrap();
            assert_eq!(retried.revision.number(), revision, "op {at}");
        }
    }
}
