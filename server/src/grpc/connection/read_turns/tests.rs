//! Pauses after calls and after large requests.

use std::future::poll_fn;

use tokio::{sync::oneshot, task::yield_now, time::advance};
use tokio_util::task::AbortOnDropHandle;

use super::*;
use crate::{admission::Admission, config::Config, grpc::read_queue::let_tasks_wait};

/// Returns the turns and the flow of a connection that has read `bytes`. A call has come if `has_calls`.
fn after(bytes: usize, has_calls: bool) -> (ReadTurns, Arc<Flow>) {
    let flow = Admission::new(&Config::default().admission, 1, 0).open();
    let mut turns = ReadTurns::new(Arc::default());
    if has_calls {
        drop(flow.turns());
    }
    turns.note(&flow, bytes, false);
    (turns, flow)
}

async fn may_read(turns: &mut ReadTurns, flow: &Flow) -> bool {
    poll_fn(|context| Poll::Ready(turns.poll(flow, context).is_ready())).await
}

/// Gives the turns of the connection.
fn giving(turns: &ReadTurns) -> AbortOnDropHandle<()> {
    let queue = Arc::clone(&turns.queue);
    AbortOnDropHandle::new(tokio::spawn(async move { queue.give_turns().await }))
}

#[tokio::test]
async fn a_connection_pauses_after_calls_sooner_than_within_a_large_request() {
    for (bytes, has_calls, pauses) in [
        (MAX_CALL_BYTES - 1, true, false),
        (MAX_CALL_BYTES, true, true),
        (MAX_REQUEST_BYTES - 1, false, false),
        (MAX_REQUEST_BYTES, false, true),
    ] {
        let (mut turns, flow) = after(bytes, has_calls);
        assert_eq!(may_read(&mut turns, &flow).await, !pauses, "{bytes}");
        assert!(pauses || turns.pause.is_none());
    }
}

#[tokio::test]
async fn a_pause_ends_with_a_turn_and_the_next_one_comes_after_as_much() {
    let (mut turns, flow) = after(MAX_CALL_BYTES, true);
    assert!(!may_read(&mut turns, &flow).await);
    assert!(!may_read(&mut turns, &flow).await);
    let _giving = giving(&turns);
    poll_fn(|context| turns.poll(&flow, context)).await;
    drop(flow.turns());
    turns.note(&flow, MAX_CALL_BYTES - 1, false);
    assert!(may_read(&mut turns, &flow).await);
    turns.note(&flow, 1, false);
    assert!(!may_read(&mut turns, &flow).await);
}

#[tokio::test(start_paused = true)]
async fn a_connection_that_sends_little_never_pauses_and_one_that_sends_much_does_under_load() {
    for (time, is_light) in [(LIGHT_TIME, true), (LIGHT_TIME / 2, false)] {
        let (mut turns, flow) = after(0, true);
        for _ in 0..2 {
            let_tasks_wait(100);
            drop(flow.turns());
            turns.note(&flow, MAX_CALL_BYTES / 2, true);
            advance(time).await;
        }
        assert_eq!(may_read(&mut turns, &flow).await, is_light);
    }
    // Without load, neither does.
    while ReadQueue::is_busy() {
        yield_now().await;
    }
    let (mut turns, flow) = after(0, true);
    for _ in 0..2 {
        turns.note(&flow, MAX_CALL_BYTES, true);
    }
    assert!(may_read(&mut turns, &flow).await);
}

#[tokio::test(start_paused = true)]
async fn a_connection_stays_late_until_it_sends_little() {
    let (mut turns, flow) = after(0, true);
    let late_since = Some(Instant::now());
    flow.note_time(Some(Duration::ZERO));
    let (granted, turn) = oneshot::channel();
    granted.send(late_since).unwrap();
    turns.pause = Some((Instant::now(), turn));
    let _giving = giving(&turns);
    for _ in 0..2 {
        poll_fn(|context| turns.poll(&flow, context)).await;
        assert_eq!(turns.late_since, late_since);
        drop(flow.turns());
        turns.note(&flow, MAX_CALL_BYTES, false);
    }
    poll_fn(|context| turns.poll(&flow, context)).await;
    advance(LIGHT_TIME).await;
    turns.note(&flow, 1, true);
    assert_eq!(turns.late_since, None);
}

/// True if `work` notes that the connection has read everything.
async fn catches_up(flow: &Flow, work: impl Future) -> bool {
    flow.catch_up();
    let now = std::time::Instant::now;
    let caught_up = now();
    let mut began = now();
    while began == caught_up {
        began = now();
    }
    work.await;
    flow.behind(began).is_zero()
}

#[tokio::test(start_paused = true)]
async fn a_connection_is_behind_from_the_last_time_that_it_had_read_everything() {
    let (mut turns, flow) = after(0, true);
    turns.note(&flow, 0, true);
    for (bytes, is_all, expected) in [
        // Bytes after a silence have just arrived.
        (1, false, true),
        (1, false, false),
        (1, true, true),
    ] {
        let noted = catches_up(&flow, async { turns.note(&flow, bytes, is_all) });
        assert_eq!(noted.await, expected, "{bytes} {is_all}");
    }
    for (pause, expected) in [(Duration::ZERO, true), (SHORT_PAUSE, false)] {
        let (mut turns, flow) = after(MAX_CALL_BYTES, true);
        let paused = catches_up(&flow, async {
            assert!(!may_read(&mut turns, &flow).await);
            advance(pause).await;
            let _giving = giving(&turns);
            poll_fn(|context| turns.poll(&flow, context)).await;
        });
        assert_eq!(paused.await, expected, "{pause:?}");
    }
    // After a pause, bytes may have waited although everything was read before.
    let (mut turns, flow) = after(MAX_CALL_BYTES, true);
    turns.was_silent = true;
    let paused = catches_up(&flow, async {
        assert!(!may_read(&mut turns, &flow).await);
        advance(SHORT_PAUSE).await;
        let _giving = giving(&turns);
        poll_fn(|context| turns.poll(&flow, context)).await;
        turns.note(&flow, 1, false);
    });
    assert!(!paused.await);
    // The arrival of a large request is no delay of the server.
    let (mut turns, flow) = after(MAX_REQUEST_BYTES, false);
    let paused = catches_up(&flow, async {
        assert!(!may_read(&mut turns, &flow).await);
    });
    assert!(paused.await);
}
