//! The disk that the parts of a data directory take.

use std::{
    fs::{self, Metadata},
    path::Path,
};

use super::STORE;
use crate::log::StoreUsage;

/// The directory of the store's tables.
const TABLES: &str = "keyspaces";

/// The bytes that the files in `directory` take on the disk. The journal's bytes include the few small files beside it.
pub(super) fn disk(directory: &Path) -> StoreUsage {
    let store = directory.join(STORE);
    let tables = taken_in(&store.join(TABLES));
    let in_store = taken_in(&store);
    StoreUsage {
        tables,
        // The files change while they are counted.
        journal: in_store.saturating_sub(tables),
        other: taken_in(directory).saturating_sub(in_store),
        ..StoreUsage::default()
    }
}

/// The disk of all files under `directory`. A file that is removed meanwhile counts as 0.
fn taken_in(directory: &Path) -> u64 {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    // A link is not followed.
    let taken = entries.map(|entry| match entry.metadata() {
        Ok(found) if found.is_dir() => taken_in(&entry.path()),
        found => found.map_or(0, |file| taken(&file)),
    });
    taken.sum()
}

/// The disk of a file. A journal file is preallocated: its length exceeds the blocks that it takes.
#[cfg(unix)]
fn taken(file: &Metadata) -> u64 {
    use std::os::unix::fs::MetadataExt;
    file.blocks() * 512
}

#[cfg(not(unix))]
fn taken(file: &Metadata) -> u64 {
    file.len()
}

#[cfg(test)]
mod tests {
    use std::{fs::File, io::Write};

    use super::*;

    #[test]
    #[cfg(unix)]
    fn each_file_counts_for_its_part_with_the_blocks_that_it_has() {
        const MIB: u64 = 1024 * 1024;
        let directory = tempfile::tempdir().unwrap();
        for (path, mib) in [
            ("store/0.jnl", 1),
            ("store/keyspaces/1/tables/7", 2),
            ("store/keyspaces/1/tables/8.jnl", 2),
            ("store.damaged-1/0.jnl", 4),
            ("marks", 1),
        ] {
            let path = directory.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            let mut file = File::create(path).unwrap();
            file.write_all(&vec![7; (mib * MIB) as usize]).unwrap();
            file.set_len(64 * MIB).unwrap();
            file.sync_all().unwrap();
        }
        let found = disk(directory.path());
        let parts = [found.journal, found.tables, found.other];
        // A file system adds blocks of its own for large files.
        assert_eq!(parts.map(|bytes| bytes / MIB), [1, 4, 5], "{found:?}");
        assert_eq!(
            disk(&directory.path().join("missing")),
            StoreUsage::default()
        );
    }
}
