//! The log is the only source of state: a second server over the same log equals the first.

use std::sync::Arc;

use rand::{RngExt, SeedableRng};
use wayfold_index::Space;
use wayfold_proto::v1;
use wayfold_server::{
    log::{Durability, FjallLog, Log, LogError, MemoryLog, PointStore, Record, Uid, View},
    registry::{Registry, RegistryOptions},
    service::{Code, Limits, Service},
};

use crate::{
    copied::copied,
    forward::{forward_catalogue, forward_points, forward_whole_journal},
    random::Requests,
    support::*,
};

#[tokio::test]
async fn a_restart_changes_nothing() {
    for seed in 0..20 {
        println!("seed {seed}");
        let directory = tempfile::tempdir().unwrap();
        let on_disk = seed % 2 == 1;
        let log = if on_disk {
            Log::from(Arc::new(
                FjallLog::open(directory.path(), Durability::Fsync).unwrap(),
            ))
        } else {
            Log::from(Arc::new(MemoryLog::new()))
        };
        let before = service_with(log.clone(), Limits::default());
        let uid = create(&before, "arm", "R2*SO2").await;
        create(&before, "empty", "SO3").await;
        let space: Space = "R2*SO2".parse().unwrap();
        let mut requests = Requests::new(seed, &space, &uid);
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        for _ in 0..40 {
            let revision = info(&before, "arm").await.revision;
            // Refused mutations are part of the history too.
            match random.random_range(0..4) {
                0..=1 => drop(
                    before
                        .insert(&CALL, requests.insert(revision.number()))
                        .await,
                ),
                2 => drop(
                    before
                        .update(&CALL, requests.update(revision.number()))
                        .await,
                ),
                _ => drop(before.remove(&CALL, requests.remove()).await),
            }
        }
        // The history has an id that was used and freed, and an operation id.
        before
            .insert(&CALL, insertion(&[[0.0; 3]], &[500]))
            .await
            .unwrap();
        before.remove(&CALL, removal(&[500])).await.unwrap();
        let operation = v1::InsertRequest {
            operation_id: "op".into(),
            ..insertion(&[[0.1; 3]], &[])
        };
        let response = before.insert(&CALL, operation.clone()).await.unwrap();
        assert_eq!(response.ids, [501]);

        let crashed = on_disk.then(|| copied(directory.path()));
        let after = match &crashed {
            Some(crashed) => {
                let log = FjallLog::open(crashed.path(), Durability::Fsync).unwrap();
                restarted(Arc::new(log))
            }
            None => restarted(log),
        };
        let same = |index: v1::Index| v1::Index {
            memory_bytes: 0,
            ..index
        };
        for name in ["arm", "empty"] {
            assert_eq!(
                same(info(&after, name).await),
                same(info(&before, name).await)
            );
        }
        assert_eq!(everything(&after).await, everything(&before).await);
        let ask = knn(&[[0.5, 0.5, 1.0], [0.0, 0.75, -3.0]], 100);
        let answer = after.knn(&CALL, ask.clone()).await.unwrap();
        assert_eq!(answer, before.knn(&CALL, ask).await.unwrap());
        assert_eq!(after.insert(&CALL, operation).await.unwrap(), response);
        let next = after
            .insert(&CALL, insertion(&[[0.2; 3]], &[]))
            .await
            .unwrap();
        assert_eq!(next.ids, [502]);
        if on_disk {
            continue;
        }
        // The first server follows the other's records and evaluates against them.
        let late = before
            .insert(&CALL, insertion(&[[0.3; 3]], &[]))
            .await
            .unwrap();
        assert_eq!(late.ids, [503]);
        assert_eq!(everything(&after).await, everything(&before).await);
    }
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
    let deletion = v1::DeleteIndexRequest {
        index_name: "damaged".into(),
        ..Default::default()
    };
    service.delete_index(&CALL, deletion).await.unwrap();
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
    }
}
