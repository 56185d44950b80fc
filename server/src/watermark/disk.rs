//! The disk of the data directory.

use std::{io, path::Path, sync::Arc};

use super::{Resource, Usage, Watermark};

/// A watermark that leaves `min_free_bytes` of the disk of `directory` free, but at most a quarter of it, and accepts
/// growth again at a quarter more. None if `min_free_bytes` is 0.
pub fn disk(directory: &Path, min_free_bytes: u64) -> Option<Arc<Watermark>> {
    let directory = directory.to_path_buf();
    let level = move || {
        let (free, limit) = room(&directory)?;
        let min_free_bytes = min_free_bytes.min(limit / 4);
        Ok(Usage {
            used: limit.saturating_sub(free),
            high: limit.saturating_sub(min_free_bytes),
            low: limit.saturating_sub(min_free_bytes.saturating_add(min_free_bytes / 4)),
            limit,
        })
    };
    (min_free_bytes > 0).then(|| Arc::new(Watermark::new(Resource::Disk, level)))
}

/// The bytes of the disk that the process can still write, and those that it has in all.
#[cfg(target_os = "linux")]
fn room(directory: &Path) -> io::Result<(u64, u64)> {
    let disk = rustix::fs::statvfs(directory)?;
    let bytes = |blocks: u64| blocks.saturating_mul(disk.f_frsize);
    Ok((bytes(disk.f_bavail), bytes(disk.f_blocks)))
}

#[cfg(not(target_os = "linux"))]
fn room(_: &Path) -> io::Result<(u64, u64)> {
    Err(io::ErrorKind::Unsupported.into())
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    #[test]
    fn at_most_a_quarter_of_the_disk_stays_free() {
        let directory = tempfile::tempdir().unwrap();
        assert!(disk(directory.path(), 0).is_none());
        let whole = disk(directory.path(), u64::MAX).unwrap();
        let limit = whole.limit().unwrap();
        let full = whole.admit(limit).unwrap_err();
        assert_eq!((full.high, full.limit), (limit - limit / 4, limit));
        let little = disk(directory.path(), 1000).unwrap();
        assert_eq!(little.admit(limit).unwrap_err().high, limit - 1000);
    }
}
