//! The directory in which the measured data directories lie, and their sizes.

use std::{
    fs::{self, File},
    io::Write,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use tempfile::TempDir;

/// A directory of data directories, on the measured disk.
pub(crate) struct BaseDirectory(TempDir);

impl BaseDirectory {
    /// Creates it in the given directory, or in the system's directory for temporary files.
    pub(crate) fn new(parent: Option<&Path>) -> Self {
        let parent = parent.map_or_else(std::env::temp_dir, PathBuf::from);
        Self(tempfile::tempdir_in(parent).expect("a directory to write in"))
    }

    /// Creates a new directory.
    pub(crate) fn create(&self) -> TempDir {
        tempfile::tempdir_in(self.0.path()).expect("a directory to write in")
    }

    /// The type and the mount source of the file system, if the system reports them.
    pub(crate) fn file_system(&self) -> Option<String> {
        let mounts = fs::read_to_string("/proc/mounts").ok()?;
        let path = self.0.path().canonicalize().ok()?;
        let mounts = mounts.lines().filter_map(|line| {
            let mut words = line.split(' ').skip(1);
            Some((words.next()?, words.next()?))
        });
        let on = mounts.filter(|(mounted, _)| path.starts_with(mounted));
        let (mounted, kind) = on.max_by_key(|(mounted, _)| mounted.len())?;
        Some(format!("{kind} on {mounted}"))
    }
}

/// A plain file that is appended to and synced.
pub(crate) struct AppendFile(File);

impl AppendFile {
    pub(crate) fn new(directory: &Path) -> Self {
        let path = directory.join("appended");
        let file = File::options().append(true).create(true).open(path);
        Self(file.expect("a file"))
    }

    /// The duration of one append of `bytes` and its fdatasync.
    pub(crate) fn append(&mut self, bytes: &[u8]) -> Duration {
        let began = Instant::now();
        self.0.write_all(bytes).expect("room on the disk");
        self.0.sync_data().expect("a disk that syncs");
        began.elapsed()
    }
}

/// The allocated bytes of all files under a directory, and the number of these files.
pub(crate) fn used(directory: &Path) -> (u64, usize) {
    let mut sum = (0, 0);
    for entry in fs::read_dir(directory).expect("a directory") {
        let entry = entry.expect("an entry");
        let metadata = entry.metadata().expect("an entry that stays");
        let (bytes, files) = if metadata.is_dir() {
            used(&entry.path())
        } else {
            (on_disk(&metadata), 1)
        };
        sum = (sum.0 + bytes, sum.1 + files);
    }
    sum
}

/// The allocated bytes of a file.
pub(crate) fn bytes_of(path: &Path) -> u64 {
    on_disk(&fs::metadata(path).expect("a file that stays"))
}

#[cfg(unix)]
fn on_disk(metadata: &fs::Metadata) -> u64 {
    // Journals are created with spare room. The unwritten part takes no space.
    std::os::unix::fs::MetadataExt::blocks(metadata) * 512
}

#[cfg(not(unix))]
fn on_disk(metadata: &fs::Metadata) -> u64 {
    metadata.len()
}
