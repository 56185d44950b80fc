//! The order of the turns, and their end under load.

use std::{future::ready, pin::pin, sync::Arc, thread};

use futures_util::poll;
use tokio::{task::yield_now, time::advance};

use super::*;

const IN_TIME: Turn = Turn { late_since: None };

/// The connections that have the next turns, by their places in `entered`.
fn turns(queue: &ReadQueue, is_busy: bool, entered: &mut [Receiver<Turn>]) -> Vec<(usize, Turn)> {
    let mut turns = Vec::new();
    while queue.give_turn(is_busy) {
        for (number, granted) in entered.iter_mut().enumerate() {
            turns.extend(granted.try_recv().map(|turn| (number, turn)));
        }
    }
    turns
}

#[tokio::test(start_paused = true)]
async fn the_connection_that_came_last_reads_first_while_few_tasks_wait() {
    let queue = ReadQueue::default();
    let mut entered = [(); 3].map(|()| queue.enter(None));
    assert_eq!(turns(&queue, true, &mut entered), []);
    let expected = [2, 1, 0].map(|number| (number, IN_TIME));
    assert_eq!(turns(&queue, false, &mut entered), expected);
}

#[tokio::test(start_paused = true)]
async fn a_late_connection_has_a_turn_under_any_load_and_when_no_other_waits() {
    let queue = ReadQueue::default();
    let mut entered = [(); 3].map(|()| queue.enter(None));
    advance(MAX_WAIT).await;
    let late_since = Some(Instant::now());
    let late = Turn { late_since };
    let expected = [0, 1, 2].map(|number| (number, late));
    assert_eq!(turns(&queue, true, &mut entered), expected);
    let mut entered = [late_since, None].map(|late_since| queue.enter(late_since));
    assert_eq!(turns(&queue, true, &mut entered), []);
    let expected = [(1, IN_TIME), (0, late)];
    assert_eq!(turns(&queue, false, &mut entered), expected);
}

#[tokio::test(start_paused = true)]
async fn the_connection_that_has_been_late_for_the_longest_returns_first() {
    let queue = ReadQueue::default();
    let now = Instant::now();
    let mut since = vec![3, 1, 2];
    for first in [1, 2, 3] {
        let late = |seconds: &u64| Some(now + Duration::from_secs(*seconds));
        let enter = |seconds| queue.enter(late(seconds));
        let mut entered: Vec<_> = since.iter().map(enter).collect();
        advance(ROTATION).await;
        let turns = turns(&queue, true, &mut entered);
        assert_eq!(turns.len(), since.len());
        for (number, turn) in turns {
            let seconds = since[number];
            let late_since = late(&seconds).filter(|_| seconds != first);
            assert_eq!(turn, Turn { late_since });
        }
        since.retain(|seconds| *seconds != first);
    }
}

#[tokio::test(start_paused = true)]
async fn a_connection_that_has_ended_takes_no_turn() {
    let queue = ReadQueue::default();
    let mut granted = queue.enter(None);
    drop(queue.enter(None));
    assert!(queue.give_turn(false));
    assert_eq!(granted.try_recv(), Ok(IN_TIME));
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
    let mut granted = queue.enter(None);
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
    assert!(poll!(giving.as_mut()).is_pending());
    assert_eq!(granted.try_recv(), Ok(IN_TIME));
}
