//! A shared index and its feed: messages that come in pieces, come twice, do not come, or are wrong.

use std::{
    fmt::Debug,
    sync::{Arc, Mutex},
    thread,
    time::{Duration, Instant},
};

use tonic::Status as Answer;
use tracing::{
    Event, Metadata,
    field::Field,
    span::{Attributes, Id, Record},
};
use wayfold::{Code, ConnectionStatus, Error, Index, InsertOptions};
use wayfold_proto::v1;

use crate::{
    fake::{Fake, revision_of},
    watching::{message, piece, scanned, wait_for, wait_until_caught_up},
};

fn reset(reason: v1::ResetReason, revision: u64) -> v1::WatchResponse {
    let mut reset = message(revision, vec![]);
    reset.set_reset(reason);
    reset
}

/// The mutation as the first batch of the first session.
fn of_first_batch(mutation: v1::Mutation) -> v1::Mutation {
    v1::Mutation {
        session: 1,
        batch: 1,
        ..mutation
    }
}

fn open(fake: &Fake) -> Index {
    Index::shared(&fake.uri, "line").open().unwrap()
}

/// Waits until the fake was asked to watch this many times. Returns these requests.
fn watch_requests(fake: &Fake, watches: usize) -> Vec<v1::WatchRequest> {
    loop {
        let mut requests = fake.watch_requests();
        if requests.len() >= watches {
            requests.truncate(watches);
            return requests;
        }
        thread::yield_now();
    }
}

/// Waits until the fake was asked to watch this many times. Returns the `after_revision` of each of these requests.
fn after_revisions(fake: &Fake, watches: usize) -> Vec<Option<u64>> {
    let requests = watch_requests(fake, watches).into_iter();
    let after = requests.map(|request| request.after_revision);
    after.map(|after| after.map(|after| after.number)).collect()
}

/// Waits until the fake was asked to watch this many times. Returns the `own_session` of each of these requests.
fn own_sessions(fake: &Fake, watches: usize) -> Vec<u64> {
    let requests = watch_requests(fake, watches).into_iter();
    requests.map(|request| request.own_session).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_feed_that_breaks_in_mid_mutation_is_taken_up_where_it_was_whole() {
    let fake = Fake::start().await;
    fake.scan_answers(scanned(3, &[(1, 0.0), (2, 10.0)]), true);
    fake.watch_tells(vec![
        Ok(message(5, vec![])),
        Ok(message(5, vec![piece(4, &[(3, 5.0)], &[], (0, false))])),
        Ok(message(5, vec![piece(5, &[(4, 6.0)], &[], (0, true))])),
        Err(Answer::unavailable("the server is stopping")),
    ]);
    fake.watch_tells(vec![
        Ok(message(5, vec![])),
        Ok(message(5, vec![piece(5, &[(4, 6.0)], &[], (0, true))])),
        Ok(message(5, vec![piece(5, &[], &[3], (1, false))])),
    ]);
    let index = open(&fake);
    wait_for(&index, &[(1, 0.0), (2, 10.0), (4, 6.0)]);
    assert_eq!(after_revisions(&fake, 2), [Some(3), Some(4)]);
    wait_until_caught_up(&index);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
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
    let index = open(&fake);
    wait_for(&index, &[(1, 0.0), (4, 4.0), (5, 5.0)]);
    assert_eq!(after_revisions(&fake, 3), [Some(3), Some(3), Some(4)]);
}

/// Five pauses, of at least half of 50, 100, 200, 400 and 800 ms.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn pauses_grow_if_feeds_open_and_cannot_go_on() {
    let fake = Fake::start().await;
    fake.scan_answers(scanned(3, &[(1, 0.0)]), true);
    for _ in 0..5 {
        let gap = message(5, vec![piece(5, &[(5, 5.0)], &[], (0, false))]);
        fake.watch_tells(vec![Ok(message(5, vec![])), Ok(gap)]);
    }
    let next = message(4, vec![piece(4, &[(4, 4.0)], &[], (0, false))]);
    fake.watch_tells(vec![Ok(message(4, vec![])), Ok(next)]);
    let began = Instant::now();
    wait_for(&open(&fake), &[(1, 0.0), (4, 4.0)]);
    let waited = began.elapsed();
    assert!(waited >= Duration::from_millis(700), "{waited:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn after_a_reset_all_points_are_read_again() {
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
    let index = open(&fake);
    wait_for(&index, &[(9, 1.0)]);
    assert_eq!(after_revisions(&fake, 3), [Some(3), Some(3), Some(9)]);
    wait_until_caught_up(&index);
}

/// The feed never named a point that the server took, and cannot do so any more.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_copy_of_an_index_that_was_made_again_shows_no_point_of_the_former() {
    let fake = Fake::start().await;
    fake.scan_answers(scanned(3, &[(1, 0.0)]), true);
    fake.takes_batches(4);
    // Its batch has a row. The feed and other calls without one fail once the index is open.
    fake.fail(|number, rows| (number >= 2 && rows == 0).then(|| Answer::unavailable("no feed")));
    let index = open(&fake);
    index.insert([5.0]).unwrap();
    index.flush().unwrap();
    let other = || revision_of("another-uid", 2);
    fake.make_again("another-uid");
    fake.watch_tells(vec![Ok(v1::WatchResponse {
        revision: other(),
        ..reset(v1::ResetReason::UidChanged, 0)
    })]);
    let mut scan = scanned(2, &[(9, 1.0)]);
    scan[0].revision = other();
    fake.scan_answers(scan, true);
    fake.fail(|_, _| None);
    while index.get(9).unwrap().is_none() {
        thread::yield_now();
    }
    assert_eq!(index.len().unwrap(), 1);
}

/// The first session has 1,000 ids, and the server reserves two at once later.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn writing_begins_again_after_the_limits_of_the_server_were_lowered() {
    let fake = Fake::start().await;
    fake.scan_answers(scanned(3, &[(1, 0.0)]), true);
    fake.takes_batches(4);
    let index = open(&fake);
    fake.limit_reserved_ids(2);
    // Fewer than half of the ids are left, so the batch reserves further ones.
    index.insert_many(vec![[0.5]; 600]).unwrap();
    let refused = index.flush().unwrap_err();
    assert_eq!(refused.reason(), Some("LIMIT_EXCEEDED"), "{refused}");
    assert_eq!(index.take_unsent().len(), 600);
    index.insert([1.5]).unwrap();
    index.flush().unwrap();
    assert_eq!(index.len().unwrap(), 2);
}

/// A refusal ends the first session, and a write begins the second one.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn the_feed_leaves_out_the_writes_of_the_session_after_a_refusal() {
    let fake = Fake::start().await;
    fake.scan_answers(scanned(3, &[(1, 0.0)]), true);
    let index = open(&fake);
    assert_eq!(own_sessions(&fake, 1), [1]);
    index.insert([0.5]).unwrap();
    let refused = index.flush().unwrap_err();
    assert_eq!(refused.code(), Code::Unimplemented, "{refused}");
    fake.takes_batches(4);
    assert_eq!(index.take_unsent().len(), 1);
    index.insert([1.5]).unwrap();
    index.flush().unwrap();
    assert_eq!(own_sessions(&fake, 2), [1, 2]);
}

/// The batch is none of the pending ones, as one that was given back although the server had taken it.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn an_own_batch_that_is_not_pending_comes_again_with_its_points() {
    let fake = Fake::start().await;
    fake.scan_answers(scanned(3, &[(1, 0.0)]), true);
    fake.watch_tells(vec![
        Ok(message(4, vec![])),
        Ok(message(
            4,
            vec![of_first_batch(piece(4, &[], &[], (0, false)))],
        )),
    ]);
    let stored = of_first_batch(piece(4, &[(9, 1.0)], &[], (0, false)));
    fake.watch_tells(vec![Ok(message(4, vec![])), Ok(message(4, vec![stored]))]);
    wait_for(&open(&fake), &[(1, 0.0), (9, 1.0)]);
    assert_eq!(own_sessions(&fake, 2), [1, 0]);
}

/// The scan after a reset never ends: the copy answers from its points meanwhile, and says what it does.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_copy_that_reads_all_points_again_says_so() {
    let fake = Fake::start().await;
    fake.scan_answers(scanned(3, &[(1, 0.0)]), true);
    fake.watch_tells(vec![
        Ok(message(9, vec![])),
        Ok(reset(v1::ResetReason::WindowPassed, 9)),
    ]);
    let mut first_part = scanned(9, &[(8, 1.0)]);
    first_part[0].point_count = 2;
    fake.scan_answers(first_part, false);
    let index = open(&fake);
    while !matches!(index.status(), Some(ConnectionStatus::Reloading)) {
        thread::yield_now();
    }
    wait_for(&index, &[(1, 0.0)]);
}

/// Gathers the fields of each event of the thread.
#[derive(Clone, Default)]
struct Events(Arc<Mutex<Vec<String>>>);

impl tracing::Subscriber for Events {
    fn enabled(&self, _: &Metadata<'_>) -> bool {
        true
    }

    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}

    fn record_follows_from(&self, _: &Id, _: &Id) {}

    fn event(&self, event: &Event<'_>) {
        let mut text = event.metadata().level().to_string();
        event.record(&mut |field: &Field, value: &dyn Debug| {
            text.push_str(&format!(" {field}={value:?}"));
        });
        self.0.lock().unwrap().push(text);
    }

    fn enter(&self, _: &Id) {}

    fn exit(&self, _: &Id) {}
}

/// The line that the drop of an index logs.
pub(super) fn logged_by_drop(index: Index) -> String {
    let events = Events::default();
    tracing::subscriber::with_default(events.clone(), || drop(index));
    let events = events.0.lock().unwrap();
    let [line] = &events[..] else {
        panic!("{events:?}");
    };
    line.clone()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_drop_logs_the_number_of_pending_writes() {
    let fake = Fake::start().await;
    fake.scan_answers(scanned(3, &[(1, 0.0)]), true);
    let index = open(&fake);
    fake.fall_silent();
    for id in [7, 8] {
        index
            .insert_with([0.5], InsertOptions::new().id(id))
            .unwrap();
    }
    let line = logged_by_drop(index);
    for part in ["WARN", "index=\"line\"", "pending=2", "unsent=0"] {
        assert!(line.contains(part), "{line}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_server_that_cannot_be_followed_ends_it() {
    let fake = Fake::start().await;
    fake.scan_answers(scanned(3, &[(1, 0.0)]), true);
    fake.watch_tells(vec![Err(Answer::unimplemented("an old server"))]);
    let index = open(&fake);
    while !matches!(index.status(), Some(ConnectionStatus::Ended { .. })) {
        thread::yield_now();
    }
    let error = index.nearest([0.0]).unwrap_err();
    assert!(matches!(error, Error::Ended { .. }), "{error}");
    assert_eq!(error.code(), Code::Unimplemented);
}

/// The copy has points that the server has lost by now. A refusal names two of them, which are not asked for again.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn payloads_of_points_that_are_gone_are_not_asked_for_again() {
    let fake = Fake::start().await;
    let known = [(1, 0.0), (2, 0.0), (3, 0.0), (4, 0.0), (5, 0.0)];
    fake.scan_answers(scanned(1, &known), true);
    let index = open(&fake);
    fake.stores(&[2, 5]);
    let payload = |id: u64| Some(id.to_string().into_bytes());
    let payloads = index.payloads(&[5, 4, 3, 5, 2, 1]).unwrap();
    assert_eq!(
        payloads,
        [payload(5), None, None, payload(5), payload(2), None]
    );
    assert_eq!(
        fake.gets(),
        [vec![1, 2, 3, 4, 5], vec![2, 4, 5], vec![2, 5]]
    );
    assert_eq!(index.payloads(&[1, 3]).unwrap(), [None, None]);
    assert_eq!(index.payload(4).unwrap(), None);
    assert_eq!(fake.gets()[3..], [vec![1, 3], vec![4]]);
}
