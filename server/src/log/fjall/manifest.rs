//! Checks that all files of the store exist, and that its lists of tables are the ones that it wrote. fjall 3 does not
//! check this. A damaged list makes it panic, abort the process, or remove tables as leftovers. It recreates missing
//! files over the existing rest.
//!
//! The store has the file `version`, the journal in files `N.jnl`, and a directory `keyspaces` with two trees: `0`
//! holds fjall's own data about its keyspaces, `1` the only keyspace. Each tree has its lists in files `v0`, `v1` and
//! so on, and a file `current` of 25 bytes: the number of the valid list (u64), the XXH3 of that list (128 bits), and 0
//! for the kind of this checksum. Numbers are little-endian. A new store is renamed once it is whole, so an interrupted
//! start leaves none of these files missing.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use xxhash_rust::xxh3::xxh3_128;

use super::{
    journal,
    store::{not_readable, shut},
};
use crate::log::{LogError, cursor::Cursor};

pub(super) const TREES: [&str; 2] = ["0", "1"];

/// The length of `current`.
pub(super) const CURRENT_BYTES: usize = 25;

/// Fails if a file of a closed store is missing, if a list is damaged, or if the disk cannot be read.
pub(super) fn check(store: &Path) -> Result<(), LogError> {
    read(&store.join("version"))?;
    let trees = store.join("keyspaces");
    for name in names(&trees)? {
        if !TREES.contains(&&*name) {
            let strange = trees.join(name);
            return Err(not_readable(format!("{} is not its", strange.display())));
        }
    }
    for tree in TREES {
        check_tree(&trees.join(tree))?;
    }
    let mut journal = names(store)?;
    journal.retain(|name| journal::number(name).is_some());
    if journal.is_empty() {
        let path = store.join("*.jnl");
        return Err(not_readable(format!("{} is missing", path.display())));
    }
    Ok(())
}

/// Fails if the list that `current` names is missing or damaged.
fn check_tree(tree: &Path) -> Result<(), LogError> {
    let damaged = |path: PathBuf| not_readable(format!("{} is damaged", path.display()));
    let path = tree.join("current");
    let current = read(&path)?;
    let Some(number) = Cursor::new(&current).u64() else {
        return Err(damaged(path));
    };
    let list_path = tree.join(format!("v{number}"));
    let list = read(&list_path)?;
    if current != encode(number, &list) {
        let is_list = current.len() == CURRENT_BYTES && current[CURRENT_BYTES - 1] == 0;
        return Err(damaged(if is_list { list_path } else { path }));
    }
    Ok(())
}

/// The content of `current` that names this list.
pub(super) fn encode(number: u64, list: &[u8]) -> [u8; CURRENT_BYTES] {
    let mut current = [0; CURRENT_BYTES];
    current[..8].copy_from_slice(&number.to_le_bytes());
    current[8..24].copy_from_slice(&xxh3_128(list).to_le_bytes());
    current
}

/// The lists of a tree, by number.
pub(super) fn lists(tree: &Path) -> Result<Vec<(u64, Vec<u8>)>, LogError> {
    let mut lists = Vec::new();
    if !tree.try_exists().map_err(|error| unreadable(tree, error))? {
        return Ok(lists);
    }
    for name in names(tree)? {
        if let Some(number) = name
            .strip_prefix('v')
            .and_then(|number| number.parse().ok())
        {
            lists.push((number, read(&tree.join(name))?));
        }
    }
    Ok(lists)
}

/// The content of a file; None if the file is missing.
pub(super) fn read_optional(path: &Path) -> Result<Option<Vec<u8>>, LogError> {
    match fs::read(path) {
        Ok(content) => Ok(Some(content)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(unreadable(path, error)),
    }
}

fn read(path: &Path) -> Result<Vec<u8>, LogError> {
    fs::read(path).map_err(|error| unreadable(path, error))
}

/// The names in a directory. A name that is not Unicode is converted lossily.
fn names(directory: &Path) -> Result<Vec<String>, LogError> {
    let names = fs::read_dir(directory).and_then(|entries| {
        let name =
            |entry: io::Result<fs::DirEntry>| Ok(entry?.file_name().to_string_lossy().into());
        entries.map(name).collect()
    });
    names.map_err(|error| unreadable(directory, error))
}

fn unreadable(path: &Path, error: io::Error) -> LogError {
    match shut(error) {
        LogError::Shut { what } => LogError::Shut {
            what: format!("{}: {what}", path.display()),
        },
        _ => not_readable(format!("{} is missing", path.display())),
    }
}
