//! An index keeps to its quotas of points, states and payloads.

use std::{collections::BTreeMap, sync::Arc};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold_proto::v1;
use wayfold_server::{
    log::MemoryLog,
    registry::RegistryOptions,
    service::{Error, Limits},
};

use crate::support::*;

#[tokio::test]
async fn quotas_of_an_index_are_exact_also_after_a_restart() {
    let quota = |error: Error| match error {
        Error::QuotaExceeded {
            index,
            limit,
            value,
            requested,
        } => (index, limit, value, requested),
        other => panic!("{other}"),
    };
    let limits = Limits {
        max_points_per_index: 30,
        ..Limits::default()
    };
    let log = Arc::new(MemoryLog::new());
    let service = service_with(Arc::clone(&log), limits.clone());
    create(&service, "arm", "R3").await;
    let ids: Vec<u64> = (0..29).collect();
    let insert = insertion(&cube(1, 29), &ids);
    service.insert(&CALL, insert.clone()).await.unwrap();
    let two = service.insert(&CALL, insertion(&cube(2, 2), &[])).await;
    let expected = ("arm".to_owned(), "max_points_per_index", 30, 31);
    assert_eq!(quota(two.unwrap_err()), expected);

    let service = restarted_with(log, options(), limits);
    let two = service.insert(&CALL, insertion(&cube(2, 2), &[])).await;
    assert_eq!(two.clone().unwrap_err().reason(), "QUOTA_EXCEEDED");
    assert_eq!(quota(two.unwrap_err()), expected);
    insert_rows(&service, &cube(2, 1), &[]).await;
    // A full index still takes what makes it no larger.
    service.insert(&CALL, insert).await.unwrap();
    let replacing = v1::InsertRequest {
        on_conflict: v1::OnConflict::Replace.into(),
        ..insertion(&cube(3, 1), &[0])
    };
    service.insert(&CALL, replacing).await.unwrap();
    let third = service.insert(&CALL, insertion(&cube(3, 1), &[]));
    assert_eq!(quota(third.await.unwrap_err()), expected);
    service.remove(&CALL, removal(&[0])).await.unwrap();
    insert_rows(&service, &cube(3, 1), &[]).await;
    // Every index has its own quota.
    create(&service, "leg", "R3").await;
    let elsewhere = v1::InsertRequest {
        index_name: "leg".into(),
        ..insertion(&cube(1, 30), &[])
    };
    service.insert(&CALL, elsewhere).await.unwrap();

    let limits = Limits {
        max_state_bytes_per_index: 24 * 10,
        ..Limits::default()
    };
    let (service, _) = arm_with("R3", limits).await;
    let eleven = service.insert(&CALL, insertion(&cube(1, 11), &[])).await;
    let expected = ("arm".to_owned(), "max_state_bytes_per_index", 240, 264);
    assert_eq!(quota(eleven.unwrap_err()), expected);
    insert_rows(&service, &cube(1, 10), &[]).await;
}

#[tokio::test]
async fn the_quota_of_payloads_follows_their_sizes() {
    const QUOTA: u64 = 100;
    let limits = Limits {
        max_payload_bytes_per_index: QUOTA,
        ..Limits::default()
    };
    let counting = RegistryOptions {
        counts_payloads: true,
        ..options()
    };
    let log = Arc::new(MemoryLog::new());
    let mut service = restarted_with(Arc::clone(&log), counting, limits);
    create(&service, "arm", "R3").await;
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut sizes = BTreeMap::<u64, u64>::new();
    let (mut taken, mut refused) = (0, 0);
    let mut quota = QUOTA;
    for step in 0..400 {
        if step % 50 == 0 {
            // Half of the time there is more than the quota: an operator has lowered it.
            quota = if step % 100 == 0 { QUOTA } else { QUOTA / 2 };
            let limits = Limits {
                max_payload_bytes_per_index: quota,
                ..Limits::default()
            };
            service = restarted_with(Arc::clone(&log), counting, limits);
        }
        let id = rng.random_range(0..8);
        let bytes = rng.random_range(0..40);
        let payloads = vec![vec![7; bytes as usize].into()];
        let done = match rng.random_range(0..4) {
            0 => {
                service.remove(&CALL, removal(&[id])).await.unwrap();
                sizes.remove(&id);
                continue;
            }
            1 if sizes.contains_key(&id) => {
                let update = v1::UpdateRequest {
                    payloads,
                    ..updating(&[id])
                };
                service.update(&CALL, update).await.map(drop)
            }
            _ => {
                let insert = v1::InsertRequest {
                    on_conflict: v1::OnConflict::Replace.into(),
                    payloads,
                    ..insertion(&cube(step, 1), &[id])
                };
                service.insert(&CALL, insert).await.map(drop)
            }
        };
        let mut after = sizes.clone();
        after.insert(id, bytes);
        let before: u64 = sizes.values().sum();
        let requested: u64 = after.values().sum();
        match done {
            Ok(()) => {
                // A mutation that makes the payloads no larger is taken.
                assert!(requested <= quota || requested <= before, "{after:?}");
                sizes = after;
                taken += 1;
            }
            Err(Error::QuotaExceeded {
                limit,
                value,
                requested: named,
                ..
            }) => {
                assert_eq!((limit, value), ("max_payload_bytes_per_index", quota));
                assert_eq!(named, requested);
                assert!(requested > quota && requested > before, "{after:?}");
                refused += 1;
            }
            Err(other) => panic!("{other}"),
        }
    }
    assert!(taken > 50 && refused > 50, "{taken}, {refused}");
}
