//! The waits of calls: for the tasks of a shared index, and for the answer of a server. The program may interrupt them.

use std::{
    sync::{
        OnceLock,
        mpsc::{Receiver, RecvTimeoutError},
    },
    time::{Duration, Instant},
};

use parking_lot::{Condvar, MutexGuard};

use crate::{Error, net::request::MAX_WAIT};

/// The time between two looks at the interrupts.
const CHECK_INTERVAL: Duration = Duration::from_millis(500);

static IS_INTERRUPTED: OnceLock<fn() -> bool> = OnceLock::new();

/// Lets the program interrupt the calls of an [`Index`](crate::Index) that wait, as a signal does. Each waiting call asks
/// `is_interrupted` twice a second, on its own thread and without a lock, and fails with [`Error::Interrupted`] once that
/// is true. Only the first function that a process sets counts.
pub fn set_interrupt_check(is_interrupted: fn() -> bool) {
    let _ = IS_INTERRUPTED.set(is_interrupted);
}

fn check() -> Result<(), Error> {
    match IS_INTERRUPTED.get() {
        Some(is_interrupted) if is_interrupted() => Err(Error::Interrupted),
        _ => Ok(()),
    }
}

/// The end of a wait, at most [`MAX_WAIT`] from now.
pub(super) fn deadline(timeout: Duration) -> Instant {
    Instant::now() + timeout.min(MAX_WAIT)
}

/// Waits for a change until `until`; false if that has passed. True may come without a change.
pub(super) fn wait_until<T>(
    changed: &Condvar,
    guard: &mut MutexGuard<'_, T>,
    until: Instant,
) -> Result<bool, Error> {
    let next_check = until.min(Instant::now() + CHECK_INTERVAL);
    if !changed.wait_until(guard, next_check).timed_out() {
        return Ok(true);
    }
    if next_check == until {
        return Ok(false);
    }
    // The check runs code of the program's, which may call the index.
    MutexGuard::unlocked(guard, check)?;
    Ok(true)
}

/// Waits for what a task sends; `None` once the task has ended.
pub(super) fn receive<T>(receiver: &Receiver<T>) -> Result<Option<T>, Error> {
    loop {
        match receiver.recv_timeout(CHECK_INTERVAL) {
            Ok(sent) => return Ok(Some(sent)),
            Err(RecvTimeoutError::Disconnected) => return Ok(None),
            Err(RecvTimeoutError::Timeout) => check()?,
        }
    }
}
