//! Low-priority threads for background work, so that calls do not queue behind it when all cores are busy.

use std::{io, thread};

/// Runs `work` on a thread of this nice value and blocks until it is done. Threads that `work` starts inherit the
/// priority.
///
/// # Errors
/// If the thread cannot be started, or `work` panics.
pub(crate) fn run<T: Send>(
    name: &str,
    nice: i32,
    work: impl FnOnce() -> T + Send,
) -> io::Result<T> {
    thread::scope(|scope| {
        let thread = thread::Builder::new().name(name.into());
        let working = thread.spawn_scoped(scope, || {
            lower_priority(nice);
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
fn lower_priority(nice: i32) {
    #[cfg(not(target_os = "linux"))]
    let _ = nice;
    #[cfg(target_os = "linux")]
    if let Err(error) = rustix::process::setpriority_process(None, nice) {
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
        assert_eq!(run("test", 3, with_child).unwrap(), (3, 3));
        assert_eq!(nice(), before);
    }

    #[test]
    fn work_that_panics_is_an_error() {
        assert!(run("test", 3, || panic!("a bug")).is_err());
    }
}
