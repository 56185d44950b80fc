//! The service answers or refuses each extreme integer, and a waiting call uses no core.

use std::{
    pin::pin,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering::Relaxed},
    },
    task::{Context, Poll, Wake, Waker},
};

use prost_reflect::{DynamicMessage, ReflectMessage};
use wayfold_proto::{
    snapshot::{Header, Writer},
    v1,
};
use wayfold_server::service::{Call, Code, Error, Service};

use crate::{
    extremes::{EXTREMES, requests, variants},
    quiet::{deadline, own_index, quietly, two_points},
    restores::restores,
    support::*,
};

/// Makes a request and reads its whole answer, a watch only up to the newest revision.
async fn ask(service: &Service, call: &Call, request: &DynamicMessage) -> Result<(), Error> {
    macro_rules! read {
        () => {
            request.transcode_to().unwrap()
        };
    }
    macro_rules! drain {
        ($stream:expr) => {{
            let mut stream = $stream;
            while let Some(part) = stream.next().await {
                part?;
            }
            Ok(())
        }};
    }
    match request.descriptor().name() {
        "KnnRequest" => service.knn(call, read!()).await.map(drop),
        "QueryRequest" => service.query(call, read!()).await.map(drop),
        "InsertRequest" => service.insert(call, read!()).await.map(drop),
        "UpdateRequest" => service.update(call, read!()).await.map(drop),
        "RemoveRequest" => service.remove(call, read!()).await.map(drop),
        "OpenSessionRequest" => service.open_session(call, read!()).await.map(drop),
        "WriteRequest" => service.write(call, read!()).await.map(drop),
        "GetRequest" => service.get(call, read!()).await.map(drop),
        "GetServerRequest" => service.get_server(call, read!(), 1 << 20).await.map(drop),
        "CreateIndexRequest" => service.create_index(call, read!()).await.map(drop),
        "GetIndexRequest" => service.get_index(call, read!()).await.map(drop),
        "ListIndexesRequest" => service.list_indexes(call, read!()).await.map(drop),
        "DeleteIndexRequest" => service.delete_index(call, read!()).await.map(drop),
        "ScanRequest" => drain!(service.scan(call, read!()).await?),
        "SnapshotIndexRequest" => drain!(service.snapshot_index(call, read!()).await?),
        "VerifyIndexRequest" => drain!(service.verify_index(call, read!()).await?),
        "WatchRequest" => {
            // A refusal of one does not spare the other.
            let log = service.log(call, read!()).await;
            let watched: Result<(), Error> =
                async { drain!(service.watch(call, read!()).await?) }.await;
            log?;
            watched
        }
        // Streams of requests exist only over gRPC.
        "StreamKnnRequest" => Ok(()),
        other => panic!("{other} is asked of nobody"),
    }
}

/// A waiting call ends at its deadline. The clock of the test is paused, so the deadline comes at once.
#[tokio::test(start_paused = true)]
async fn every_verb_answers_or_refuses_extreme_integers() {
    let (shared, uid) = two_points().await;
    for request in requests(&uid) {
        let (mut taken, mut is_shared) = (0, true);
        for (at, (what, mut variant)) in variants(&request).into_iter().enumerate() {
            println!("{what}");
            let mut service = shared.clone();
            if let Some(own) = own_index(&request, at).await {
                ((service, variant), is_shared) = (own, false);
            }
            let call = Call {
                deadline: Some(deadline()),
                ..Call::default()
            };
            match quietly(ask(&service, &call, &variant)).await {
                Ok(()) => taken += 1,
                Err(error) => {
                    assert_ne!(error.code(), Code::Internal, "{error}");
                    assert_ne!(error.code(), Code::DataLoss, "{error}");
                }
            }
        }
        assert!(taken > 1 || is_shared, "{request:?}");
    }
    assert!(info(&shared, "arm").await.revision.number() > 2);
}

#[tokio::test(start_paused = true)]
async fn the_requests_that_are_varied_are_good_ones() {
    let (service, uid) = two_points().await;
    for request in requests(&uid) {
        let call = Call {
            deadline: Some(deadline()),
            ..Call::default()
        };
        let answer = ask(&service, &call, &request).await;
        let code = answer.map_err(|error| error.code());
        let expected = match request.descriptor().name() {
            // The call waits for a revision that does not exist.
            "WatchRequest" => Err(Code::DeadlineExceeded),
            "DeleteIndexRequest" => Err(Code::FailedPrecondition),
            _ => Ok(()),
        };
        assert_eq!(code, expected, "{request:?}");
    }
}

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
