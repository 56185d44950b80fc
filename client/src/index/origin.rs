//! The process that something belongs to. A fork copies memory, but neither the other threads nor the locks they hold.
//!
//! A request to the system for the number of the process at each call would slow a planner, so a hook of the C library
//! counts forks. It is the only unsafe code of this package.

use std::sync::{
    OnceLock,
    atomic::{AtomicU64, Ordering},
};

use crate::Error;

/// The number of forks between the first process that asked and this one.
static FORKS: AtomicU64 = AtomicU64::new(0);

/// The process in which this value was made.
#[derive(Clone, Copy, Debug)]
pub(super) struct Origin {
    forks: u64,
}

impl Origin {
    /// This process.
    pub(super) fn current() -> Origin {
        static HOOKED: OnceLock<()> = OnceLock::new();
        HOOKED.get_or_init(count_forks);
        Origin {
            forks: FORKS.load(Ordering::Relaxed),
        }
    }

    /// True in the process in which this value was made, and false in those forked from it.
    pub(super) fn is_current(self) -> bool {
        FORKS.load(Ordering::Relaxed) == self.forks
    }

    /// Refuses a call in a process that was forked from the one in which this value was made.
    pub(super) fn check(self) -> Result<(), Error> {
        match self.is_current() {
            true => Ok(()),
            false => Err(Error::Forked),
        }
    }
}

/// Counts the forks from now on. Without memory for the hook, a fork goes unnoticed.
#[cfg(unix)]
#[expect(unsafe_code, reason = "the C library alone tells of a fork")]
fn count_forks() {
    extern "C" fn forked() {
        FORKS.fetch_add(1, Ordering::Relaxed);
    }
    // SAFETY: `forked` is a static function that only adds to an atomic, which is allowed in a forked process.
    let _unnoticed = unsafe { libc::pthread_atfork(None, None, Some(forked)) };
}

#[cfg(not(unix))]
fn count_forks() {}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    #[expect(unsafe_code, reason = "the standard library cannot fork")]
    fn a_forked_process_is_another() {
        let origin = Origin::current();
        assert!(origin.is_current());
        // SAFETY: the child calls nothing but an atomic load and `_exit`.
        let status = unsafe {
            let child = libc::fork();
            if child == 0 {
                libc::_exit(i32::from(origin.is_current()));
            }
            assert!(child > 0, "a child process");
            let mut status = -1;
            assert_eq!(libc::waitpid(child, &raw mut status, 0), child);
            status
        };
        assert_eq!(status, 0, "the child took itself for its parent");
        assert!(origin.is_current());
    }
}
