//! A replica and its server: messages that come in pieces, come twice, do not come, or are wrong.

use std::time::Duration;

use tonic::Status;
use wayfold::{
    Client, Code, Error, Filter, Replica, ReplicaRequest, ReplicaSearch as Search, ReplicaStatus,
    RetryPolicy, Revision,
};
use wayfold_proto::v1;

use crate::{
    fake::{self, Fake},
    server::Server,
    watching::{message, piece, points},
};

/// The points that a scan finds at a revision.
fn scanned(revision: u64, found: &[(u64, f64)]) -> Vec<v1::ScanResponse> {
    vec![v1::ScanResponse {
        points: Some(points(revision, found)),
        revision: fake::revision(revision),
        point_count: found.len() as u64,
        held_scan: String::new(),
    }]
}

/// A replica that tries again at once.
async fn request(fake: &Fake) -> ReplicaRequest {
    let hasty = RetryPolicy {
        attempts: 1,
        first: Duration::from_millis(1),
        longest: Duration::from_millis(1),
    };
    let client = Client::builder().retry(hasty).connect(&fake.uri).await;
    client.unwrap().replica("line")
}

fn nearest(replica: &Replica, x: f64) -> (u64, u64) {
    let found = replica.knn([x], 1).unwrap();
    (found.nearest().unwrap().id, found.revision().number)
}

fn reset(reason: v1::ResetReason, revision: u64) -> v1::WatchResponse {
    let mut reset = message(revision, vec![]);
    reset.set_reset(reason);
    reset
}

/// A revision of the fake's index.
fn revision(number: u64) -> Revision {
    Revision::new(fake::UID, number)
}

/// The `after_revision` of each of the first `watches` requests to watch.
fn after_revisions(fake: &Fake, watches: usize) -> Vec<Option<u64>> {
    let requests = fake.watch_requests().into_iter().take(watches);
    requests
        .map(|request| request.after_revision.map(|revision| revision.number))
        .collect()
}

#[tokio::test]
async fn a_stream_that_breaks_in_mid_mutation_is_taken_up_where_it_was_whole() {
    let fake = Fake::start().await;
    fake.scan_answers(scanned(3, &[(1, 0.0), (2, 10.0)]), true);
    fake.watch_tells(vec![
        Ok(message(5, vec![])),
        Ok(message(5, vec![piece(4, &[(3, 5.0)], &[], (0, false))])),
        Ok(message(5, vec![piece(5, &[(4, 6.0)], &[], (0, true))])),
        Err(Status::unavailable("the server is stopping")),
    ]);
    fake.watch_tells(vec![
        Ok(message(5, vec![])),
        Ok(message(5, vec![piece(5, &[(4, 6.0)], &[], (0, true))])),
        Ok(message(5, vec![piece(5, &[], &[3], (1, false))])),
    ]);
    let replica = request(&fake).await.await.unwrap();
    assert_eq!(replica.at_least(&revision(5)).await.unwrap().len(), 3);
    assert_eq!(nearest(&replica, 5.0), (4, 5));
    assert_eq!(after_revisions(&fake, 2), [Some(3), Some(4)]);
    let status = replica.status();
    assert!(
        matches!(
            &status,
            ReplicaStatus::Following { revision: at, behind: 0 } if *at == revision(5)
        ),
        "{status:?}"
    );
}

#[tokio::test]
async fn a_gap_and_a_repeat_are_not_applied_but_asked_for_again() {
    let fake = Fake::start().await;
    fake.scan_answers(scanned(3, &[(1, 0.0)]), true);
    fake.watch_tells(vec![
        Ok(message(5, vec![])),
        Ok(message(5, vec![piece(5, &[(5, 5.0)], &[], (0, false))])),
    ]);
    fake.watch_tells(vec![
        Ok(message(5, vec![])),
        Ok(message(5, vec![piece(4, &[(4, 4.0)], &[], (0, false))])),
        Ok(message(5, vec![piece(4, &[(4, 9.0)], &[1], (0, false))])),
    ]);
    fake.watch_tells(vec![
        Ok(message(5, vec![])),
        Ok(message(5, vec![piece(5, &[(5, 5.0)], &[], (0, false))])),
    ]);
    let replica = request(&fake).await.await.unwrap();
    let view = replica.at_least(&revision(5)).await.unwrap();
    let found = view.query([4.5], 100.0).unwrap();
    let ids: Vec<u64> = found.iter().map(|neighbor| neighbor.id).collect();
    assert_eq!(ids, [4, 5, 1]);
    assert_eq!(after_revisions(&fake, 3), [Some(3), Some(3), Some(4)]);
}

#[tokio::test]
async fn after_a_reset_all_points_are_read_anew() {
    let fake = Fake::start().await;
    fake.scan_answers(scanned(3, &[(1, 0.0)]), true);
    fake.watch_tells(vec![
        Ok(message(9, vec![])),
        Ok(message(9, vec![piece(4, &[(2, 1.0)], &[], (0, true))])),
        Ok(reset(v1::ResetReason::WindowPassed, 9)),
    ]);
    // The first scan announces more points than it sends.
    let mut short = scanned(9, &[(8, 1.0)]);
    short[0].point_count = 2;
    fake.scan_answers(short, true);
    fake.watch_tells(vec![Ok(reset(v1::ResetReason::WindowPassed, 9))]);
    fake.scan_answers(scanned(9, &[(9, 1.0)]), true);
    fake.watch_tells(vec![Ok(message(9, vec![]))]);
    let replica = request(&fake).await.await.unwrap();
    replica.at_least(&revision(9)).await.unwrap();
    assert_eq!(nearest(&replica, 0.0), (9, 9));
    replica
        .status_where(|status| {
            matches!(status, ReplicaStatus::Following { revision: at, .. } if *at == revision(9))
        })
        .await;
    assert_eq!(after_revisions(&fake, 3), [Some(3), Some(3), Some(9)]);
}

#[tokio::test]
async fn while_there_is_no_server_it_answers_what_it_had_until_that_is_stale() {
    let fake = Fake::start().await;
    fake.scan_answers(scanned(3, &[(1, 0.0)]), true);
    let replica = request(&fake).await.await.unwrap();
    fake.scan_answers(scanned(3, &[(1, 0.0)]), true);
    let bound = Duration::from_millis(1);
    let bounded = request(&fake).await.max_staleness(bound).await.unwrap();
    fake.fail(|_, _| Some(Status::unavailable("the server is stopping")));
    for replica in [&replica, &bounded] {
        replica
            .status_where(|status| matches!(status, ReplicaStatus::Disconnected { .. }))
            .await;
    }
    assert_eq!(nearest(&replica, 7.0), (1, 3));
    let stale = replica.clone();
    assert!(stale.at_least_within(&revision(4), bound).await.is_err());
    // More time has passed than the bound allows.
    let Err(Error::Stale { age, .. }) = bounded.knn([7.0], 1) else {
        panic!("an answer that may be stale")
    };
    assert!(age > bound);
    assert!(matches!(bounded.view(), Err(Error::Stale { .. })));
}

#[tokio::test]
async fn a_server_that_cannot_be_followed_ends_it() {
    let fake = Fake::start().await;
    fake.scan_answers(scanned(3, &[(1, 0.0)]), true);
    fake.watch_tells(vec![Err(Status::unimplemented("an old server"))]);
    let replica = request(&fake).await.await.unwrap();
    let error = replica.at_least(&revision(4)).await.unwrap_err();
    assert!(matches!(error, Error::Ended { .. }), "{error}");
    assert_eq!(error.code(), Code::Unimplemented);
}

#[tokio::test]
async fn a_search_that_takes_too_long_fails() {
    let fake = Fake::start().await;
    let points: Vec<(u64, f64)> = (0..4000).map(|id| (id, id as f64)).collect();
    fake.scan_answers(scanned(3, &points), true);
    let replica = request(&fake).await.await.unwrap();
    let all = Search::within(f64::INFINITY);
    assert_eq!(replica.search([0.0], &all).unwrap().len(), 4000);
    let late = replica.search([0.0], &all.timeout(Duration::ZERO));
    assert!(matches!(late, Err(Error::Timeout { .. })), "{late:?}");
}

#[tokio::test]
async fn what_the_server_refuses_the_replica_refuses_in_the_same_words() {
    let server = Server::start();
    let index = server.index("arm", "R1*SO3").await;
    let inserted = index.insert([[0.5, 0.0, 0.0, 0.0, 1.0]]).await.unwrap();
    let replica = server.client().await.replica("arm").await.unwrap();
    let good = [0.0, 0.0, 0.0, 0.0, 1.0];
    let bad = [
        [f64::NAN, 0.0, 0.0, 0.0, 1.0],
        [0.0, 0.0, 0.0, f64::NEG_INFINITY, 1.0],
        [1e200, 0.0, 0.0, 0.0, 1.0],
        [0.0, 1.0, 0.0, 0.0, 1.0],
    ];
    let outside = Filter::default().tag(1, 6);
    let mut requests: Vec<([f64; 5], u32, f64, f64, Filter)> = bad
        .map(|state| (state, 1, 1.0, 0.0, Filter::default()))
        .into();
    requests.extend([
        (good, 0, 1.0, 0.0, Filter::default()),
        (good, 1, -1.0, 0.0, Filter::default()),
        (good, 1, f64::NAN, 0.0, Filter::default()),
        (good, 1, 1.0, f64::INFINITY, Filter::default()),
        (bad[0], 1, 1.0, -0.5, outside),
    ]);
    for (state, k, radius, epsilon, filter) in requests {
        let request = index.knn([state]).k(k).radius(radius).epsilon(epsilon);
        let theirs = request.filter(filter.clone()).await.unwrap_err();
        let search = Search::k(k).radius(radius).epsilon(epsilon).filter(filter);
        let ours = replica.search(state, &search).unwrap_err();
        let (Error::Refused(theirs), Error::Refused(ours)) = (theirs, ours) else {
            panic!("{search:?}")
        };
        assert_eq!(ours, theirs);
    }
    assert!(matches!(replica.knn([0.0], 1), Err(Error::Width { .. })));
    let pose = nalgebra::Isometry2::translation(0.0, 0.0);
    assert!(matches!(replica.knn(pose, 1), Err(Error::Layout { .. })));
    let next = index.revision_at(inserted.revision.number + 1);
    let later = replica.search(good, &Search::k(1).filter(Filter::default().since(next)));
    assert!(matches!(later, Err(Error::Behind { .. })), "{later:?}");
    let other = Filter::default().since(Revision::new("another", 1));
    let theirs = index.knn([good]).filter(other.clone()).await.unwrap_err();
    let ours = replica
        .search(good, &Search::k(1).filter(other))
        .unwrap_err();
    assert_eq!(
        (ours.code(), ours.reason()),
        (theirs.code(), theirs.reason())
    );
}

#[test]
fn a_replica_whose_runtime_is_gone_says_so() {
    let server = Server::start();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let replica = runtime.block_on(async {
        server.index("line", "R1").await;
        server.client().await.replica("line").await.unwrap()
    });
    assert!(replica.knn([0.0], 1).unwrap().is_empty());
    drop(runtime);
    let error = replica.knn([0.0], 1).unwrap_err();
    assert!(matches!(error, Error::Ended { .. }), "{error}");
    assert!(matches!(replica.status(), ReplicaStatus::Ended { .. }));
}
