//! The size of the process's memory pages.

/// Turns transparent huge pages off for this process. Only Linux has them; elsewhere this does nothing.
///
/// The allocator asks for huge pages. A merge allocates and frees whole levels, so the kernel clears megabytes of fresh
/// pages again and again while calls wait for the core. With small pages, batches are inserted faster, points reach a
/// subscriber sooner, and searches of a large index take the same time.
pub fn use_small_pages() {
    #[cfg(target_os = "linux")]
    if let Err(error) = rustix::thread::disable_transparent_huge_pages(true) {
        tracing::debug!(%error, "cannot turn huge pages off: merges take more processor time");
    }
}
