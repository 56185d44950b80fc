//! Low-priority threads for the store's background work, so that calls do not queue behind it when all cores are busy.
//!
//! Merges run at normal priority: every search is slower until they are done.

use std::{io, thread};

/// The nice value of these threads. At 5 a thread gets a third of the processor time of a thread that answers calls
/// (Linux weighs them 335 to 1,024), so a server that is never idle still moves points out of its journal.
const NICE: i32 = 5;

/// Runs `work` on a low-priority thread and blocks until it is done. Threads that `work` starts inherit the priority.
///
/// # Errors
/// If the thread cannot be started, or `work` panics.
pub(crate) fn run<T: Send>(name: &str, work: impl FnOnce() -> T + Send) -> io::Result<T> {
    thread::scope(|scope| {
        let thread = thread::Builder::new().name(name.into());
        let working = thread.spawn_scoped(scope, || {
            lower_priority();
            work()
        })?;
        working.join().map_err(|_| panicked())
    })
}

/// The error names no cause: the panic hook has printed it.
fn panicked() -> io::Error {
    io::Error::other("the low-priority thread panicked")
}

/// Lowers the priority of this thread. Only Linux has a priority per thread; elsewhere this does nothing.
fn lower_priority() {
    #[cfg(target_os = "linux")]
    if let Err(error) = rustix::process::setpriority_process(None, NICE) {
        tracing::debug!(%error, "cannot lower the thread priority: background work runs at the priority of calls");
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    fn nice() -> i32 {
        rustix::process::getpriority_process(None).expect("a priority")
    }

    #[test]
    fn the_priority_is_lowered_for_the_work_and_its_threads_only() {
        let before = nice();
        let with_child = || (nice(), thread::spawn(nice).join().unwrap());
        assert_eq!(run("test", with_child).unwrap(), (NICE, NICE));
        assert_eq!(nice(), before);
    }

    #[test]
    fn work_that_panics_is_an_error() {
        assert!(run("test", || panic!("a bug")).is_err());
    }
}
