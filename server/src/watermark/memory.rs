//! The memory of the process and its limit, as Linux tells them.

use std::{
    fs, io,
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
};

// Linked for `mi_collect`.
use mimalloc as _;
use tracing::{debug, warn};

use super::{MERGE_PARTS, Resource, Usage, Watermark};

/// The root of the mounted control groups.
const CGROUPS: &str = "/sys/fs/cgroup";

/// The most that the use of memory grows before freed memory is given back.
const MAX_UNRELEASED: u64 = 16 * 1024 * 1024;

/// A watermark of the process's memory at these percentages of `limit_bytes`, or of the limit that the system sets if
/// that is 0; and lower if merges and the `call_bytes` that calls may hold would not fit above it. None if the system tells
/// no use or no limit: only Linux does.
pub fn memory(
    limit_bytes: u64,
    high_percent: u64,
    low_percent: u64,
    call_bytes: u64,
) -> Option<Arc<Watermark>> {
    let (limit, used) = match (self::limit(limit_bytes), used()) {
        (Ok(limit), Ok(used)) => (limit, used),
        (Err(error), _) | (_, Err(error)) => {
            warn!(%error, "cannot measure memory: nothing is refused for it");
            return None;
        }
    };
    let of_others = call_bytes.saturating_add(limit / MERGE_PARTS);
    let high = (limit / 100 * high_percent).min(limit.saturating_sub(of_others));
    let low = high / high_percent * low_percent.min(high_percent);
    debug!(limit, high, low, used, "watermarks of memory");
    let level = move || {
        let mut used = self::used()?;
        if used > low {
            release_to_os(true);
            used = self::used()?;
        }
        Ok(Usage {
            used,
            high,
            low,
            limit,
        })
    };
    let watermark = Watermark::new(Resource::Memory, level);
    Some(Arc::new(watermark.reserving(call_bytes)))
}

/// The memory that the process may use: `set`, or the limit of the system if that is 0.
pub(crate) fn limit(set: u64) -> io::Result<u64> {
    if set > 0 {
        return Ok(set);
    }
    let machine = kilobytes(&fs::read_to_string("/proc/meminfo")?, "MemTotal:")?;
    let groups = fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    Ok(group_limit(Path::new(CGROUPS), &groups).map_or(machine, |limit| limit.min(machine)))
}

/// The smallest memory limit of the control groups that `/proc/self/cgroup` lists, those above them included.
fn group_limit(root: &Path, groups: &str) -> Option<u64> {
    let files = groups.lines().filter_map(|line| {
        let (controllers, path) = line.split_once(':')?.1.split_once(':')?;
        let is_memory = controllers.split(',').any(|name| name == "memory");
        let (root, file) = match (controllers.is_empty(), is_memory) {
            (true, _) => (root.to_path_buf(), "memory.max"),
            (false, true) => (root.join("memory"), "memory.limit_in_bytes"),
            (false, false) => return None,
        };
        let path = PathBuf::from(path.trim_start_matches('/'));
        let above: Vec<PathBuf> = path.ancestors().map(|group| root.join(group)).collect();
        Some(above.into_iter().map(move |group| group.join(file)))
    });
    // A group without a limit says "max", which is no number.
    let limits = files.flatten().filter_map(|file| {
        let text = fs::read_to_string(file).ok()?;
        text.trim().parse().ok()
    });
    limits.min()
}

/// The bytes that only the process holds. Pages of files are not counted: the kernel takes them back.
fn used() -> io::Result<u64> {
    kilobytes(&fs::read_to_string("/proc/self/status")?, "RssAnon:")
}

/// Gives freed memory that the allocator keeps back to the system: all of it with `force`, and without it the memory that
/// was freed a second ago or earlier. The allocator itself looks for such memory only while threads allocate and end, so
/// that of the last merges would stay.
pub(crate) fn release_to_os(force: bool) {
    #[expect(
        unsafe_code,
        reason = "the allocator offers this function to C only; it takes a flag and may be called at any time"
    )]
    unsafe {
        mi_collect(force);
    }
}

/// Gives freed memory back to the system if the use of memory has grown since it was last given back. Each merge frees
/// whole levels, which would stay for seconds while an index grows. May take milliseconds.
pub(crate) fn release_if_grown() {
    static AFTER_RELEASE: AtomicU64 = AtomicU64::new(0);
    let Ok(used) = used() else { return };
    if used > AFTER_RELEASE.load(Relaxed) + MAX_UNRELEASED {
        release_to_os(true);
        AFTER_RELEASE.store(self::used().unwrap_or(used), Relaxed);
    } else {
        AFTER_RELEASE.fetch_min(used, Relaxed);
    }
}

#[expect(unsafe_code, reason = "a function of the allocator")]
unsafe extern "C" {
    /// mimalloc frees the memory that it keeps unused; with `force` it returns all of it to the system.
    fn mi_collect(force: bool);
}

/// The bytes in the line that begins with `name`, which gives them in units of 1,024.
fn kilobytes(text: &str, name: &str) -> io::Result<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix(name));
    let number = line.and_then(|line| line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok());
    let missing = || io::Error::new(io::ErrorKind::InvalidData, format!("no line {name}"));
    Ok(number.ok_or_else(missing)? * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_proc() {
        let status = "Name:\tx\nRssAnon:\t   9604 kB\nRssFile:\t 1 kB\n";
        assert_eq!(kilobytes(status, "RssAnon:").unwrap(), 9604 * 1024);
        assert!(kilobytes(status, "RssShmem:").is_err());
        assert!(kilobytes("RssAnon: many", "RssAnon:").is_err());
    }

    #[test]
    fn the_smallest_limit_of_a_group_and_those_above_it() {
        let root = tempfile::tempdir().unwrap();
        let set = |file: &str, text: &str| {
            let file = root.path().join(file);
            fs::create_dir_all(file.parent().unwrap()).unwrap();
            fs::write(file, text).unwrap();
        };
        let found = |groups: &str| group_limit(root.path(), groups);
        assert_eq!(found("0::/a/b\n"), None);
        set("a/b/memory.max", "max\n");
        assert_eq!(found("0::/a/b\n"), None);
        set("a/memory.max", "4096\n");
        assert_eq!(found("0::/a/b\n"), Some(4096));
        set("a/b/memory.max", "8192\n");
        assert_eq!(found("0::/a/b\n"), Some(4096));
        set("memory/c/memory.limit_in_bytes", "1024\n");
        let both = "3:cpu,cpuacct:/c\n2:memory:/c\n0::/a\n";
        assert_eq!(found(both), Some(1024));
        assert_eq!(found("3:cpu,cpuacct:/c\n"), None);
    }
}
