//! Pauses after calls and after large requests, and their ends.

use std::{
    future::{poll_fn, ready},
    sync::Arc,
    thread,
};

use tokio::time::advance;

use super::*;
use crate::{admission::Admission, config::Config};

/// A connection that has read so many bytes, with a call or without.
fn after(bytes: usize, has_calls: bool) -> (ReadTurns, Arc<Flow>) {
    let flow = Admission::new(&Config::default().admission, 1, 0).open();
    let mut turns = ReadTurns::new();
    if has_calls {
        drop(flow.turns());
    }
    turns.note(&flow, Some(bytes));
    (turns, flow)
}

async fn may_read(turns: &mut ReadTurns, flow: &Flow) -> bool {
    poll_fn(|context| Poll::Ready(turns.poll(flow, context).is_ready())).await
}

/// Lets so many tasks wait in the queue of all threads.
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

/// HTTP/2 asks for bytes again and again within one poll.
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
async fn a_pause_lasts_while_many_tasks_wait_but_for_a_second_at_most() {
    let (mut turns, flow) = after(MAX_CALL_BYTES, true);
    assert!(!may_read(&mut turns, &flow).await);
    for _ in 0..3 {
        yield_now().await;
        let_tasks_wait(MAX_WAITING_TASKS + 1);
        assert!(!may_read(&mut turns, &flow).await);
    }
    advance(MAX_PAUSE).await;
    let_tasks_wait(MAX_WAITING_TASKS + 1);
    assert!(may_read(&mut turns, &flow).await);
    // A turn under load is short.
    drop(flow.turns());
    turns.note(&flow, Some(MAX_CALL_BYTES));
    assert!(!may_read(&mut turns, &flow).await);
}

#[tokio::test]
async fn a_turn_after_a_pause_is_long() {
    let (mut turns, flow) = after(MAX_CALL_BYTES, true);
    poll_fn(|context| turns.poll(&flow, context)).await;
    drop(flow.turns());
    turns.note(&flow, Some(MAX_TURN_BYTES - 1));
    assert!(may_read(&mut turns, &flow).await);
    turns.note(&flow, Some(1));
    assert!(!may_read(&mut turns, &flow).await);
}
