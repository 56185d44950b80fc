//! The order of the turns, and their end under load.

use std::{future::ready, pin::pin, sync::Arc, thread};

use futures_util::poll;
use tokio::time::advance;

use super::*;

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
    let long = [2, 1, 0].map(|number| (number, Turn::Long));
    assert_eq!(turns(&queue, false, &mut entered), long);
}

#[tokio::test(start_paused = true)]
async fn late_connections_have_short_turns_under_load_and_return_one_by_one() {
    let queue = ReadQueue::default();
    let mut entered = [(); 3].map(|()| queue.enter(None));
    advance(MAX_WAIT).await;
    let late_since = Some(Instant::now());
    let short = |number| (number, Turn::Short { late_since });
    let expected = [(0, Turn::Long), short(1), short(2)];
    assert_eq!(turns(&queue, true, &mut entered), expected);
    // The first has been late for as long as the second, and came back later.
    let mut entered = [2, 1].map(|_| queue.enter(late_since));
    let later = late_since.map(|since| since + ROTATION / 2);
    let mut last = queue.enter(later);
    advance(ROTATION).await;
    assert_eq!(turns(&queue, true, &mut entered), [(0, Turn::Long)]);
    advance(ROTATION).await;
    assert_eq!(turns(&queue, true, &mut entered), [(1, Turn::Long)]);
    assert!(last.try_recv().is_err());
    // Without load nothing waits.
    assert!(queue.give_turn(false));
    assert_eq!(last.try_recv(), Ok(Turn::Long));
}

#[tokio::test(start_paused = true)]
async fn a_connection_that_has_ended_takes_no_turn() {
    let queue = ReadQueue::default();
    let mut granted = queue.enter(None);
    drop(queue.enter(None));
    assert!(queue.give_turn(false));
    assert_eq!(granted.try_recv(), Ok(Turn::Long));
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
    assert_eq!(granted.try_recv(), Ok(Turn::Long));
}
