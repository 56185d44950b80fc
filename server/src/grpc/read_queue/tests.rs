//! The order of the turns, under load and without.

use std::{future::ready, pin::pin, sync::Arc, thread};

use futures_util::poll;
use tokio::time::advance;

use super::*;

type Entered = Receiver<Option<Instant>>;

/// The connections that have the next turns, by their places in `entered`, and the times since which they are late.
fn turns(
    queue: &ReadQueue,
    is_busy: bool,
    entered: &mut [Entered],
) -> Vec<(usize, Option<Instant>)> {
    let mut turns = Vec::new();
    while queue.give_turn(is_busy) {
        for (number, granted) in entered.iter_mut().enumerate() {
            turns.extend(granted.try_recv().map(|late_since| (number, late_since)));
        }
    }
    turns
}

#[tokio::test(start_paused = true)]
async fn patient_connections_read_in_their_order_and_hurried_ones_in_the_other() {
    for (are_hurried, expected) in [
        ([false, false, false, false], [0, 1, 2, 3]),
        ([true, true, true, true], [3, 2, 1, 0]),
        // The two kinds take turns.
        ([true, false, true, false], [1, 2, 3, 0]),
    ] {
        let queue = ReadQueue::default();
        let mut entered = are_hurried.map(|is_hurried| queue.enter(is_hurried, None));
        assert_eq!(turns(&queue, true, &mut entered), []);
        let expected = expected.map(|number| (number, None));
        assert_eq!(turns(&queue, false, &mut entered), expected);
    }
}

#[tokio::test(start_paused = true)]
async fn a_connection_has_a_turn_under_any_load_after_a_while() {
    for is_hurried in [false, true] {
        let queue = ReadQueue::default();
        let mut entered = [(); 3].map(|()| queue.enter(is_hurried, None));
        advance(MAX_WAIT).await;
        let late_since = Some(Instant::now());
        let late = late_since.filter(|_| is_hurried);
        let expected = [0, 1, 2].map(|number| (number, late));
        assert_eq!(turns(&queue, true, &mut entered), expected);
        let mut entered = [late_since, None].map(|late_since| queue.enter(is_hurried, late_since));
        assert_eq!(turns(&queue, true, &mut entered), []);
        let expected = [(1, None), (0, late_since)];
        assert_eq!(turns(&queue, false, &mut entered), expected);
    }
}

#[tokio::test(start_paused = true)]
async fn a_connection_that_becomes_late_waits_for_none_that_came_after_it() {
    let queue = ReadQueue::default();
    let mut entered = vec![queue.enter(true, None)];
    advance(MAX_WAIT / 2).await;
    entered.push(queue.enter(true, Some(Instant::now())));
    advance(MAX_WAIT / 2).await;
    let expected = [(0, Some(Instant::now()))];
    assert_eq!(turns(&queue, true, &mut entered), expected);
}

#[tokio::test(start_paused = true)]
async fn the_connection_that_has_been_late_for_the_longest_returns_first() {
    let queue = ReadQueue::default();
    let now = Instant::now();
    let late = |seconds| Some(now + Duration::from_secs(seconds));
    let mut since = vec![3, 1, 2];
    for first in [1, 2, 3] {
        // One that has ended does not return.
        drop(queue.enter(true, Some(now)));
        // A patient one has a turn like the others.
        let mut patient = queue.enter(false, None);
        let enter = |seconds: &u64| queue.enter(true, late(*seconds));
        let mut entered: Vec<_> = since.iter().map(enter).collect();
        advance(ROTATION).await;
        let turns = turns(&queue, true, &mut entered);
        assert_eq!(turns.len(), since.len());
        assert_eq!(patient.try_recv(), Ok(None));
        for (number, late_since) in turns {
            let seconds = since[number];
            assert_eq!(late_since, late(seconds).filter(|_| seconds != first));
        }
        since.retain(|seconds| *seconds != first);
    }
}

#[tokio::test(start_paused = true)]
async fn a_connection_that_has_ended_takes_no_turn() {
    let queue = ReadQueue::default();
    drop(queue.enter(false, None));
    let mut granted = queue.enter(false, None);
    assert!(queue.give_turn(false));
    assert_eq!(granted.try_recv(), Ok(None));
    assert!(!queue.give_turn(false));
    assert!(queue.waiting.lock().is_empty());
}

/// Adds `tasks` tasks to the global queue of the runtime.
pub(crate) fn let_tasks_wait(tasks: usize) {
    let runtime = Handle::current();
    let spawn = move || {
        for _ in 0..tasks {
            runtime.spawn(ready(()));
        }
    };
    thread::spawn(spawn).join().unwrap();
}

#[tokio::test]
async fn turns_wait_until_few_tasks_wait() {
    let queue = Arc::new(ReadQueue::default());
    let mut giving = pin!(queue.give_turns());
    let mut granted = queue.enter(false, None);
    assert!(poll!(giving.as_mut()).is_pending());
    for _ in 0..3 {
        let_tasks_wait(MAX_WAITING_TASKS + 1);
        assert!(poll!(giving.as_mut()).is_pending());
        assert!(granted.try_recv().is_err());
        yield_now().await;
    }
    while ReadQueue::is_busy() {
        yield_now().await;
    }
    while granted.try_recv().is_err() {
        assert!(poll!(giving.as_mut()).is_pending());
        yield_now().await;
    }
}
