//! The service answers or refuses each extreme integer, and a waiting call uses no core.

use std::{
    pin::pin,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering::Relaxed},
    },
    task::{Context, Poll, Wake, Waker},
};

use wayfold_proto::{
    snapshot::{Header, Writer},
    v1,
};
use wayfold_server::service::{Code, Error, Service};

use crate::{
    extremes::EXTREMES,
    quiet::{quietly, two_points},
    restores::restores,
    support::*,
};

/// Restores an index, and inserts a point into it.
async fn restore_and_insert(
    service: &Service,
    requests: Vec<v1::RestoreIndexRequest>,
) -> Result<(), Error> {
    let name = requests[0].name.clone();
    let mut restoring = service.restore_index(&CALL)?;
    for request in requests {
        restoring.add(request).await?;
    }
    restoring.finish().await?;
    let insert = v1::InsertRequest {
        index_name: name,
        ..insertion(&[[0.25]], &[])
    };
    service.insert(&CALL, insert).await.map(drop)
}

#[tokio::test(start_paused = true)]
async fn snapshots_with_extreme_integers_are_restored_or_refused() {
    let service = service();
    for (at, (what, requests)) in restores().into_iter().enumerate() {
        println!("{what}");
        match quietly(restore_and_insert(&service, requests)).await {
            Ok(()) => {}
            Err(error) => {
                assert_ne!(at, 0, "{error}");
                assert_ne!(error.code(), Code::Internal, "{error}");
                assert_ne!(error.code(), Code::DataLoss, "{error}");
            }
        }
    }
}

/// Counts the wake-ups of the polled future.
#[derive(Default)]
struct WakeCounter(AtomicUsize);

impl Wake for WakeCounter {
    fn wake(self: Arc<Self>) {
        self.0.fetch_add(1, Relaxed);
    }
}

/// Polls a future that has to wait, and asserts that it is not woken before there is news.
fn assert_rests(waiting: impl Future) {
    let wakes = Arc::new(WakeCounter::default());
    let waker = Waker::from(Arc::clone(&wakes));
    let mut waiting = pin!(waiting);
    let polled = waiting.as_mut().poll(&mut Context::from_waker(&waker));
    assert!(matches!(polled, Poll::Pending));
    assert_eq!(wakes.0.load(Relaxed), 0);
}

#[tokio::test(start_paused = true)]
async fn a_call_that_waits_rests() {
    let (service, uid) = two_points().await;
    let head = info(&service, "arm").await.revision.number();
    for number in EXTREMES.into_iter().filter(|number| *number > head) {
        let read = v1::KnnRequest {
            min_revision: revision(&uid, number),
            ..knn(&[[0.5]], 1)
        };
        assert_rests(service.knn(&CALL, read));
        let snapshot = v1::SnapshotIndexRequest {
            index_name: "arm".into(),
            min_revision: revision(&uid, number),
        };
        assert_rests(service.snapshot_index(&CALL, snapshot));
        let verify = v1::VerifyIndexRequest {
            index_name: "arm".into(),
            min_revision: revision(&uid, number),
            ..Default::default()
        };
        assert_rests(service.verify_index(&CALL, verify));
    }
    for after in EXTREMES.into_iter().filter(|after| *after >= head) {
        let follow = v1::WatchRequest {
            index_name: "arm".into(),
            after_revision: revision(&uid, after),
            include: None,
            own_session: after,
        };
        match service.watch(&CALL, follow).await {
            Ok(mut watch) => {
                let first = watch.next().await.unwrap().unwrap();
                assert_eq!(first.revision.number(), head);
                assert_rests(watch.next());
            }
            Err(error) => {
                assert_eq!(after, u64::MAX);
                assert_eq!(refusal::<()>(Err(error)).2, "after_revision.number");
            }
        }
    }
}

#[tokio::test]
async fn an_index_is_restored_only_if_its_revisions_leave_room_for_others() {
    for revision in EXTREMES {
        let service = service();
        let header = Writer::new().header(&Header {
            name: "arm".into(),
            uid: "another".into(),
            space: "R1".parse().unwrap(),
            revision,
            next_id: 0,
            point_count: 0,
            payload_encoding: Default::default(),
        });
        let mut restoring = service.restore_index(&CALL).unwrap();
        let begun = restoring
            .add(v1::RestoreIndexRequest {
                name: "arm".into(),
                part: Some(header),
            })
            .await;
        if revision < 1 << 63 {
            begun.unwrap();
        } else {
            assert_eq!(refusal(begun).0, Code::InvalidArgument);
        }
    }
}
