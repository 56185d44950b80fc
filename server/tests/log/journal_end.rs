//! Finds the end of a store's journal, for the tests that damage it.

use std::{
    fs,
    path::{Path, PathBuf},
};

/// The newest journal file of a store, and the number of bytes written to it. The rest of the file is zeros.
pub(crate) fn newest_journal(store: &Path) -> (PathBuf, u64) {
    let journals = fs::read_dir(store).unwrap().filter_map(|file| {
        let path = file.unwrap().path();
        let name = path.file_name()?.to_str()?;
        let number: u64 = name.strip_suffix(".jnl")?.parse().ok()?;
        Some((number, path))
    });
    let (_, journal) = journals.max().unwrap();
    let bytes = fs::read(&journal).unwrap();
    let used = bytes.iter().rposition(|&byte| byte != 0).unwrap() + 1;
    (journal, used as u64)
}
