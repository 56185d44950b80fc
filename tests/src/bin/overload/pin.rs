//! Cores and priorities of threads. Linux only: elsewhere nothing is pinned.

/// The nice value of the threads that make load.
#[cfg(target_os = "linux")]
const NICE: i32 = 5;

/// Pins this thread, and the threads and processes that it starts from now on.
///
/// # Panics
/// If there is no such core.
pub(crate) fn to_core(core: usize) {
    #[cfg(target_os = "linux")]
    {
        let mut cores = rustix::thread::CpuSet::new();
        cores.set(core);
        let pinned = rustix::thread::sched_setaffinity(None, &cores);
        assert!(pinned.is_ok(), "this process cannot run on core {core}");
    }
    #[cfg(not(target_os = "linux"))]
    let _ = core;
}

/// Lowers the priority of this thread, so that the threads that take times go first on their common core.
pub(crate) fn lower_priority() {
    #[cfg(target_os = "linux")]
    let _ = rustix::process::setpriority_process(None, NICE);
}

/// Raises the limit of open files as far as this process may.
pub(crate) fn raise_file_limit() {
    #[cfg(target_os = "linux")]
    set_file_limit(rustix::process::getrlimit(rustix::process::Resource::Nofile).maximum);
}

/// Gives this process the limit of open files that most systems set: a server raises it by itself.
pub(crate) fn usual_file_limit() {
    #[cfg(target_os = "linux")]
    set_file_limit(Some(1024));
}

#[cfg(target_os = "linux")]
fn set_file_limit(current: Option<u64>) {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    let maximum = getrlimit(Resource::Nofile).maximum;
    let _ = setrlimit(Resource::Nofile, Rlimit { current, maximum });
}
