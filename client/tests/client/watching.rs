//! Following an index: whole mutations, in order, or an error, or a reset.

use std::{thread, time::Duration};

use tokio::time::timeout;
use tonic::Status;
use tonic_types::{ErrorDetails, StatusExt};
use wayfold::{
    Code, ConnectionStatus, Error, Include, Index, Mutation, ResetReason, Watch, WatchEvent,
};
use wayfold_proto::v1;

use crate::{
    fake::{Fake, revision},
    server::Server,
};

/// A message with these mutations.
pub(crate) fn message(newest: u64, mutations: Vec<v1::Mutation>) -> v1::WatchResponse {
    v1::WatchResponse {
        revision: revision(newest),
        mutations,
        reset: None,
    }
}

/// A mutation of the line, or a piece of one.
pub(crate) fn piece(
    number: u64,
    stored: &[(u64, f64)],
    removed: &[u64],
    (piece, continued): (u32, bool),
) -> v1::Mutation {
    let stored = (!stored.is_empty()).then(|| points(number, stored));
    v1::Mutation {
        revision: revision(number),
        time_ms: 1_000 + number,
        stored,
        removed_ids: removed.to_vec(),
        continued,
        piece,
        session: 0,
        batch: 0,
    }
}

/// Points of the line, all stored by one revision.
fn points(revision: u64, points: &[(u64, f64)]) -> v1::Points {
    v1::Points {
        ids: points.iter().map(|(id, _)| *id).collect(),
        states: Some(v1::States {
            row_count: u32::try_from(points.len()).unwrap(),
            coordinates: points.iter().map(|(_, x)| *x).collect(),
        }),
        tags: vec![0; points.len()],
        revisions: vec![revision; points.len()],
        payloads: Vec::new(),
    }
}

/// The points that a scan finds at a revision.
pub(crate) fn scanned(revision: u64, found: &[(u64, f64)]) -> Vec<v1::ScanResponse> {
    vec![v1::ScanResponse {
        points: Some(points(revision, found)),
        revision: self::revision(revision),
        point_count: found.len() as u64,
        held_scan: String::new(),
    }]
}

/// Waits until an index has these points and no others.
pub(crate) fn wait_for(index: &Index, expected: &[(u64, f64)]) {
    let content = || -> Vec<(u64, f64)> {
        let points = index.scan().unwrap().map(Result::unwrap);
        points.map(|point| (point.id, point.state[0])).collect()
    };
    while content() != expected {
        thread::yield_now();
    }
}

/// Waits until a shared index follows its server and is not behind.
pub(crate) fn wait_until_caught_up(index: &Index) {
    while !matches!(
        index.status(),
        Some(ConnectionStatus::Following { behind: 0 })
    ) {
        thread::yield_now();
    }
}

async fn mutation(watch: &mut Watch) -> Mutation {
    match watch.next().await.unwrap().unwrap() {
        WatchEvent::Mutation(mutation) => *mutation,
        other => panic!("{other:?}"),
    }
}

async fn watch(fake: &Fake) -> Watch {
    let index = fake.client().await.index("line").await.unwrap();
    let after = index.revision_at(3);
    index.watch().after(after).await.unwrap()
}

#[tokio::test]
async fn pieces_are_put_together() {
    let fake = Fake::start().await;
    fake.watch_tells(vec![
        Ok(message(5, vec![])),
        Ok(message(
            5,
            vec![
                piece(4, &[(1, 0.5)], &[], (0, false)),
                piece(5, &[(2, 1.0)], &[], (0, true)),
            ],
        )),
        Ok(message(6, vec![piece(5, &[(3, 2.0)], &[7], (1, true))])),
        Ok(message(6, vec![piece(5, &[], &[8, 9], (2, false))])),
    ]);
    let mut watch = watch(&fake).await;
    assert_eq!(mutation(&mut watch).await.revision.number, 4);
    let whole = mutation(&mut watch).await;
    assert_eq!(
        (whole.revision.number, whole.stored.ids()),
        (5, &[2, 3][..])
    );
    assert_eq!(whole.stored.states().unwrap().coordinates(), [1.0, 2.0]);
    assert_eq!(whole.removed_ids, [7, 8, 9]);
    assert_eq!(watch.newest().number, 6);
    let request = &fake.watch_requests()[0];
    assert_eq!(request.after_revision, revision(3));
}

#[tokio::test]
async fn a_message_that_is_no_next_mutation_ends_the_watch() {
    let fake = Fake::start().await;
    let other_uid = v1::WatchResponse {
        revision: Some(v1::Revision {
            uid: "another".to_owned(),
            number: 9,
        }),
        ..message(9, vec![])
    };
    let wrong = [
        // A gap, a repeat, another mutation in the middle of one, and another uid.
        vec![message(9, vec![piece(5, &[(1, 0.0)], &[], (0, false))])],
        vec![message(9, vec![piece(3, &[(1, 0.0)], &[], (0, false))])],
        vec![
            message(9, vec![piece(4, &[(1, 0.0)], &[], (0, true))]),
            message(9, vec![piece(5, &[(1, 0.0)], &[], (0, false))]),
        ],
        // A piece without the one before it.
        vec![message(9, vec![piece(4, &[(1, 0.0)], &[], (1, false))])],
        vec![
            message(9, vec![piece(4, &[(1, 0.0)], &[], (0, true))]),
            message(9, vec![piece(4, &[(1, 0.0)], &[], (2, false))]),
        ],
        vec![other_uid],
    ];
    for messages in wrong {
        let first = vec![Ok(message(9, vec![]))];
        let messages = messages.into_iter().map(Ok);
        fake.watch_tells(first.into_iter().chain(messages).collect());
        let mut watch = watch(&fake).await;
        let error = watch.next().await.unwrap_err();
        assert!(matches!(error, Error::Protocol { .. }), "{error}");
        assert_eq!(watch.next().await.unwrap(), None);
    }
}

#[tokio::test]
async fn a_stream_that_breaks_goes_on_without_a_gap_or_a_repetition() {
    let fake = Fake::start().await;
    let breaks = || Err(Status::unavailable("the server is stopping"));
    let first = |continued| piece(4, &[(1, 0.0)], &[], (0, continued));
    let next = piece(5, &[], &[1], (0, false));
    fake.watch_tells(vec![
        Ok(message(5, vec![])),
        Ok(message(5, vec![first(true)])),
        breaks(),
    ]);
    // One that ends at once.
    fake.watch_tells(vec![Ok(message(5, vec![])), breaks()]);
    fake.watch_tells(vec![Ok(message(5, vec![first(false)])), breaks()]);
    fake.watch_tells(vec![Ok(message(5, vec![next])), breaks()]);
    let mut watch = watch(&fake).await;
    let whole = mutation(&mut watch).await;
    assert_eq!((whole.revision.number, whole.stored.ids()), (4, &[1][..]));
    assert_eq!(mutation(&mut watch).await.removed_ids, [1]);
    let begun = fake.watch_requests().into_iter();
    let after: Vec<_> = begun.map(|request| request.after_revision).collect();
    assert_eq!(after, [3, 3, 3, 4].map(revision));
}

#[tokio::test]
async fn a_busy_server_is_asked_again_for_the_rest_of_a_watch() {
    let fake = Fake::start().await;
    fake.watch_tells(vec![
        Ok(message(3, vec![])),
        Err(Status::unavailable("the server is stopping")),
    ]);
    let whole = piece(4, &[(1, 0.0)], &[], (0, false));
    fake.watch_tells(vec![Ok(message(4, vec![whole]))]);
    let mut watch = watch(&fake).await;
    // More refusals than the attempts of a call.
    fake.fail(|number, _| {
        let details = ErrorDetails::with_retry_info(Some(Duration::from_millis(1)));
        let busy = || Status::with_error_details(Code::ResourceExhausted, "busy", details);
        (number < 7).then(busy)
    });
    assert_eq!(mutation(&mut watch).await.revision.number, 4);
}

#[tokio::test]
async fn a_watch_that_no_server_serves_ends_after_the_timeout() {
    let broken = || Status::unavailable("its index is damaged");
    for stays_away in [true, false] {
        let fake = Fake::start().await;
        // A server that takes every watch and ends it at once serves none.
        for _ in 0..1_000 {
            fake.watch_tells(vec![Ok(message(5, vec![])), Err(broken())]);
        }
        let index = fake.client().await.index("line").await.unwrap();
        let index = index.with_timeout(Duration::from_secs(2));
        let mut watch = index.watch().await.unwrap();
        if stays_away {
            fake.unavailable(usize::MAX);
        }
        let error = watch.next().await.unwrap_err();
        // The time may end during a try.
        let is_it = matches!(error.code(), Code::Unavailable | Code::DeadlineExceeded);
        assert!(is_it, "{error}");
        assert_eq!(watch.next().await.unwrap(), None);
        let tries = if stays_away {
            fake.calls()
        } else {
            fake.watch_requests().len()
        };
        assert!(tries > 2, "{tries}");
    }
}

/// A dropped future loses neither an event nor the progress to the next server.
#[tokio::test]
async fn a_caller_who_stops_waiting_again_and_again_still_sees_the_watch_go_on() {
    let fake = Fake::start().await;
    let breaks = || Err(Status::unavailable("the server is stopping"));
    for _ in 0..3 {
        fake.watch_tells(vec![Ok(message(4, vec![])), breaks()]);
    }
    let whole = piece(4, &[(1, 0.0)], &[], (0, false));
    fake.watch_tells(vec![Ok(message(4, vec![whole]))]);
    let mut watch = watch(&fake).await;
    let event = loop {
        // Less than the pause before a try.
        if let Ok(event) = timeout(Duration::from_millis(1), watch.next()).await {
            break event.unwrap().unwrap();
        }
    };
    assert!(
        matches!(&event, WatchEvent::Mutation(mutation) if mutation.revision.number == 4),
        "{event:?}"
    );
}

#[tokio::test]
async fn a_reset_is_the_last_event() {
    let fake = Fake::start().await;
    let mut reset = message(12, vec![]);
    reset.set_reset(v1::ResetReason::WindowPassed);
    fake.watch_tells(vec![
        Ok(message(4, vec![])),
        Ok(message(4, vec![piece(4, &[(1, 0.0)], &[], (0, true))])),
        Ok(reset),
    ]);
    let mut watch = watch(&fake).await;
    let WatchEvent::Reset(reset) = watch.next().await.unwrap().unwrap() else {
        panic!("half a mutation")
    };
    assert_eq!(
        (reset.reason, reset.revision.number),
        (ResetReason::WindowPassed, 12)
    );
    assert_eq!(watch.next().await.unwrap(), None);
}

#[tokio::test]
async fn a_server_tells_what_is_done_to_its_index() {
    let server = Server::start();
    let index = server.index("line", "R1").await;
    index.insert([[0.0]]).await.unwrap();
    let mut from_now = index.watch().await.unwrap();
    let all = index.watch().after(index.revision_at(0));
    let mut all = all.include(Include::all()).await.unwrap();
    index
        .insert([[1.0], [2.0]])
        .payloads(["a", "b"])
        .await
        .unwrap();
    index.update([2]).tags([7]).await.unwrap();
    index.remove([0, 1]).await.unwrap();
    assert_eq!(mutation(&mut all).await.revision.number, 1);
    let inserted = mutation(&mut all).await;
    assert_eq!(inserted.stored.point(1).payload.unwrap(), "b");
    let same = mutation(&mut from_now).await;
    assert_eq!(
        (same.revision.number, same.stored.point(1).payload),
        (2, None)
    );
    let updated = mutation(&mut all).await;
    let point = updated.stored.point(0);
    assert_eq!((point.id, point.tag, point.revision), (2, 7, 2));
    let removed = mutation(&mut all).await;
    assert_eq!(
        (removed.revision.number, &removed.removed_ids[..]),
        (4, &[0, 1][..])
    );

    let client = server.client().await;
    client.delete_index("line").await.unwrap();
    let error = all.next().await.unwrap_err();
    assert_eq!(error.code(), Code::NotFound);
    // A handle of the index that was: the new one has another uid.
    let new = server.index("line", "R1").await;
    let mut old = index.watch().after(index.revision_at(4)).await.unwrap();
    let WatchEvent::Reset(reset) = old.next().await.unwrap().unwrap() else {
        panic!("a mutation of another index")
    };
    assert_eq!(
        (reset.reason, reset.revision),
        (ResetReason::UidChanged, new.revision_at(0))
    );
}

/// A watch from now on with a handle of an index that is another one by now.
#[tokio::test]
async fn a_watch_from_now_on_of_another_uid_begins_with_a_reset() {
    let server = Server::start();
    let old = server.index("line", "R1").await;
    server.client().await.delete_index("line").await.unwrap();
    let new = server.index("line", "R1").await;
    let mut watch = old.watch().await.unwrap();
    let WatchEvent::Reset(reset) = watch.next().await.unwrap().unwrap() else {
        panic!("a mutation of another index")
    };
    assert_eq!(
        (reset.reason, reset.revision),
        (ResetReason::UidChanged, new.revision_at(0))
    );
    assert_eq!(watch.next().await.unwrap(), None);
}
