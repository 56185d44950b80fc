//! Pauses after calls and after large requests, and their ends.

use std::{
    future::{poll_fn, ready},
    sync::Arc,
    thread,
};

use tokio::time::advance;

use super::*;
use crate::{admission::Admission, config::Config};

/// Returns the turns and the flow of a connection that has read `bytes`. A call has come if `has_calls`.
fn after(bytes: usize, has_calls: bool) -> (ReadTurns, Arc<Flow>) {
    let flow = Admission::new(&Config::default().admission, 1, 0).open();
    let mut turns = ReadTurns::new(Pauses::default());
    if has_calls {
        drop(flow.turns());
    }
    turns.note(&flow, bytes, false);
    (turns, flow)
}

async fn may_read(turns: &mut ReadTurns, flow: &Flow) -> bool {
    poll_fn(|context| Poll::Ready(turns.poll(flow, context).is_ready())).await
}

/// Adds `tasks` tasks to the global queue of the runtime.
fn let_tasks_wait(tasks: usize) {
    let runtime = Handle::current();
    let spawn = move || {
        for _ in 0..tasks {
            runtime.spawn(ready(()));
        }
    };
    thread::spawn(spawn).join().unwrap();
}

#[tokio::test]
async fn a_connection_pauses_after_calls_sooner_than_within_a_large_request() {
    for (bytes, has_calls, pauses) in [
        (MAX_CALL_BYTES - 1, true, false),
        (MAX_CALL_BYTES, true, true),
        (MAX_TURN_BYTES - 1, false, false),
        (MAX_TURN_BYTES, false, true),
    ] {
        let (mut turns, flow) = after(bytes, has_calls);
        assert_eq!(may_read(&mut turns, &flow).await, !pauses, "{bytes}");
    }
}

/// HTTP/2 polls the connection several times within one poll of its task.
#[tokio::test]
async fn a_pause_lasts_until_others_had_their_turns() {
    let (mut turns, flow) = after(MAX_CALL_BYTES, true);
    let other = tokio::spawn(ready(()));
    let asked = poll_fn(|context| {
        let asked = [(); 3].map(|()| turns.poll(&flow, context).is_pending());
        Poll::Ready(asked)
    });
    assert_eq!(asked.await, [true; 3]);
    poll_fn(|context| turns.poll(&flow, context)).await;
    assert!(other.is_finished());
}

#[tokio::test(start_paused = true)]
async fn a_pause_lasts_while_many_tasks_wait_but_not_for_ever() {
    let (mut turns, flow) = after(MAX_CALL_BYTES, true);
    assert!(!may_read(&mut turns, &flow).await);
    for _ in 0..3 {
        yield_now().await;
        let_tasks_wait(MAX_WAITING_TASKS + 2);
        assert!(!may_read(&mut turns, &flow).await);
    }
    advance(MAX_PAUSE).await;
    let_tasks_wait(MAX_WAITING_TASKS + 2);
    assert!(may_read(&mut turns, &flow).await);
    // A turn under load is short.
    drop(flow.turns());
    turns.note(&flow, MAX_CALL_BYTES, false);
    assert!(!may_read(&mut turns, &flow).await);
}

#[tokio::test]
async fn a_turn_after_a_pause_is_long() {
    let (mut turns, flow) = after(MAX_CALL_BYTES, true);
    poll_fn(|context| turns.poll(&flow, context)).await;
    drop(flow.turns());
    turns.note(&flow, MAX_TURN_BYTES - 1, false);
    assert!(may_read(&mut turns, &flow).await);
    turns.note(&flow, 1, false);
    assert!(!may_read(&mut turns, &flow).await);
}

/// A thousand paused connections fill the global queue by themselves.
#[tokio::test]
async fn pauses_do_not_wait_for_each_other() {
    const OTHERS: usize = 100;
    let (mut turns, flow) = after(MAX_CALL_BYTES, true);
    let others: Vec<_> = (0..OTHERS).map(|_| Pause::begin(&turns.pauses)).collect();
    assert!(!may_read(&mut turns, &flow).await);
    yield_now().await;
    let_tasks_wait(MAX_WAITING_TASKS + OTHERS + 2);
    assert!(!may_read(&mut turns, &flow).await);
    yield_now().await;
    // Fewer tasks wait now than the limit and the pauses allow.
    let_tasks_wait(1);
    assert!(may_read(&mut turns, &flow).await);
    drop(others);
    assert_eq!(turns.pauses.0.load(Relaxed), 0);
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
            poll_fn(|context| turns.poll(&flow, context)).await;
        });
        assert_eq!(paused.await, expected, "{pause:?}");
    }
    // The arrival of a large request is no delay of the server.
    let (mut turns, flow) = after(MAX_TURN_BYTES, false);
    let paused = catches_up(&flow, async {
        assert!(!may_read(&mut turns, &flow).await);
    });
    assert!(paused.await);
}
