//! Threads for work that can wait: what the store does by itself. They yield to those that answer calls: where all cores are
//! busy, who waits for an answer does not wait for them. (Merges do not yield: every search takes longer until they are done.)

use std::{io, thread};

/// How much they yield, in the system's nice values: with 5 a thread gets a third of what one gets that answers calls, so
/// that a server that is never idle still moves points out of its journal.
const NICE: i32 = 5;

/// Runs `work` on a thread of its own, and waits for it where one may block. Threads that it starts yield as it does.
///
/// # Errors
/// If there can be no thread, or the work panics.
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

/// The panic itself was told of where it took place.
fn panicked() -> io::Error {
    io::Error::other("it panicked")
}

/// Lowers the priority of this thread. Elsewhere than on Linux a process has one priority for all its threads.
fn lower_priority() {
    #[cfg(target_os = "linux")]
    if let Err(error) = rustix::process::setpriority_process(None, NICE) {
        tracing::debug!(%error, "background work has the priority of calls");
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    fn nice() -> i32 {
        rustix::process::getpriority_process(None).expect("a priority")
    }

    #[test]
    fn background_work_yields_and_so_do_its_threads_and_nobody_else() {
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
