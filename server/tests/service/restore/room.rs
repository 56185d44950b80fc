//! A restore needs room for its index from its first part on.

use std::sync::Arc;

use wayfold_proto::v1;
use wayfold_server::{
    log::MemoryLog,
    service::{Code, Limits},
};

use crate::support::{snapshots::*, *};

#[tokio::test]
async fn the_limit_of_indices_is_kept() {
    let limits = Limits {
        max_indexes: 1,
        ..Limits::default()
    };
    let service = service_with(Arc::new(MemoryLog::new()), limits.clone());
    lived_in(&service, "R1", 2).await;
    let parts = snapshot(&service, "arm").await;
    let refused = refusal(restore(&service, "leg", &parts).await);
    let expected = (Code::ResourceExhausted, "LIMIT_EXCEEDED");
    assert_eq!((refused.0, refused.1), expected);

    // An index that is being restored counts.
    let service = service_with(Arc::new(MemoryLog::new()), limits);
    let mut begun = service.restore_index(&CALL).unwrap();
    let (name, part) = ("arm".into(), Some(parts[0].clone()));
    let message = v1::RestoreIndexRequest { name, part };
    begun.add(message).await.unwrap();
    let refused = refusal(restore(&service, "leg", &parts).await);
    assert_eq!((refused.0, refused.1), expected);
    drop(begun);
    restore(&service, "leg", &parts).await.unwrap();
}

/// The one that begins has the place, however many begin at once.
#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn of_restores_that_begin_at_once_those_that_have_room_end() {
    let limits = Limits {
        max_indexes: 2,
        ..Limits::default()
    };
    let source = service();
    lived_in(&source, "R1", 2).await;
    let parts = Arc::new(snapshot(&source, "arm").await);
    for _ in 0..20 {
        let target = service_with(Arc::new(MemoryLog::new()), limits.clone());
        let restores = (0..8).map(|at| {
            let (target, parts) = (target.clone(), Arc::clone(&parts));
            tokio::spawn(async move { restore(&target, &format!("leg-{at}"), &parts).await })
        });
        let mut restored = 0;
        for restore in restores.collect::<Vec<_>>() {
            restored += usize::from(restore.await.unwrap().is_ok());
        }
        assert_eq!(restored, 2);
    }
}

/// The first part waits for other changes.
#[tokio::test]
async fn a_first_part_is_no_larger_than_any_header() {
    let service = service();
    let part = v1::SnapshotPart {
        number: 1,
        content: vec![0; 1 << 20].into(),
        ..Default::default()
    };
    let message = v1::RestoreIndexRequest {
        name: "arm".into(),
        part: Some(part),
    };
    let mut restoring = service.restore_index(&CALL).unwrap();
    let refused = refusal(restoring.add(message).await);
    assert_eq!(refused, (Code::InvalidArgument, "TOO_LARGE", "part".into()));
}
