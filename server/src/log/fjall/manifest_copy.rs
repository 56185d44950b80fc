//! A copy of the small files that every index depends on: for each tree, `current` and the list that it names.
//!
//! One flipped bit in the 25 bytes of `current` would lose every index while all tables are whole. [`mend`] restores
//! such a file, but only if the copy is proven to be the last version that the store wrote. An older list may name
//! fewer tables, and fjall removes the tables that its list does not name. The XXH3 in `current` proves a list even if
//! a few bits of `current` are wrong. Without a legible `current`, the copy proves the list only if the disk holds the
//! same list and no newer one.

use std::{
    fs::{self, File},
    io::{self, Write},
    path::Path,
};

use tracing::warn;

use super::{
    STORE,
    directory::{Directory, sync_directory},
    layout::{seal, unseal},
    manifest::{CURRENT_BYTES, TREES, encode, lists, read_optional},
    store::shut,
};
use crate::log::{LogError, cursor::Cursor};

/// The name of the copy in the data directory.
pub(super) const FILE: &str = "manifest-copy";
/// The copy while it is written; it is renamed once it is synced.
const NEW_FILE: &str = "manifest-copy.new";

/// The content of fjall 3's file `version`.
const VERSION: &[u8] = b"FJL\x03";

/// Two unrelated XXH3 values differ in more bits than this, except with a probability below 2^-80.
const MAX_FLIPPED_BITS: u32 = 8;

/// The number of a list, and the list.
type List = (u64, Vec<u8>);

/// Rewrites the copy if the files have changed. Fails if fjall is changing a tree at this moment.
pub(super) fn save(directory: &Directory) -> io::Result<()> {
    let mut copy = Vec::new();
    for tree in TREES {
        let tree = directory.join(STORE).join("keyspaces").join(tree);
        let current = fs::read(tree.join("current"))?;
        let number = Cursor::new(&current).u64().unwrap_or_default();
        let list = fs::read(tree.join(format!("v{number}")))?;
        if current != encode(number, &list) {
            return Err(io::Error::other("it is being changed"));
        }
        copy.extend_from_slice(&number.to_le_bytes());
        copy.extend_from_slice(&(list.len() as u64).to_le_bytes());
        copy.extend_from_slice(&list);
    }
    let copy = seal(FILE.as_bytes(), copy);
    let path = directory.join(FILE);
    match fs::read(&path).is_ok_and(|saved| saved == copy) {
        true => Ok(()),
        false => replace(directory, &path, &copy),
    }
}

fn decode(copy: &[u8]) -> Option<Vec<List>> {
    let mut cursor = Cursor::new(unseal(FILE.as_bytes(), copy)?);
    let lists = TREES.map(|_| {
        let (number, length) = (cursor.u64()?, cursor.length()?);
        Some((number, cursor.take(length)?.to_vec()))
    });
    lists.into_iter().collect()
}

/// Restores each damaged or missing file whose content is proven. [`manifest::check`](super::manifest::check) reports
/// the others.
pub(super) fn mend(directory: &Directory) -> Result<(), LogError> {
    let store = directory.join(STORE);
    // The data directory's own version names the form of the store.
    put_back(directory, &store.join("version"), VERSION)?;
    let copies = read_optional(&directory.join(FILE))?.and_then(|copy| decode(&copy));
    let mut copies = copies.unwrap_or_default().into_iter();
    for tree in TREES {
        let tree = store.join("keyspaces").join(tree);
        mend_tree(directory, &tree, copies.next())?;
    }
    Ok(())
}

fn mend_tree(directory: &Directory, tree: &Path, copy: Option<List>) -> Result<(), LogError> {
    let path = tree.join("current");
    let current = read_optional(&path)?.unwrap_or_default();
    let mut lists = lists(tree)?;
    let is_newest = lists.iter().max() == copy.as_ref();
    lists.extend(copy.clone());
    let distances = lists.into_iter().filter_map(|(number, list)| {
        let distance = distance(&current, &encode(number, &list))?;
        Some((distance, (number, list)))
    });
    let proven = distances.min().map(|(_, list)| list);
    let Some((number, list)) = proven.or(copy.filter(|_| is_newest)) else {
        return Ok(());
    };
    put_back(directory, &tree.join(format!("v{number}")), &list)?;
    put_back(directory, &path, &encode(number, &list))
}

/// The number of bits in which a damaged `current` differs from `expected`; None if its length differs.
fn distance(current: &[u8], expected: &[u8; CURRENT_BYTES]) -> Option<u32> {
    let current: &[u8; CURRENT_BYTES] = current.try_into().ok()?;
    let bits = current.iter().zip(expected);
    let bits = bits.map(|(a, b)| (a ^ b).count_ones()).sum();
    let has_sum = current[8..24] == expected[8..24];
    (has_sum || bits <= MAX_FLIPPED_BITS).then_some(bits)
}

/// Replaces the content of a file, if it differs from `content`.
fn put_back(directory: &Directory, path: &Path, content: &[u8]) -> Result<(), LogError> {
    if read_optional(path)?.as_deref() == Some(content) {
        return Ok(());
    }
    replace(directory, path, content).map_err(shut)?;
    warn!(file = %path.display(), "a shared file of the store was damaged or missing: it is put back");
    Ok(())
}

/// Replaces a file whole or not at all, durably.
fn replace(directory: &Directory, path: &Path, content: &[u8]) -> io::Result<()> {
    let new = directory.join(NEW_FILE);
    let mut file = File::create(&new)?;
    file.write_all(content)?;
    file.sync_all()?;
    fs::rename(&new, path)?;
    path.parent().map_or(Ok(()), sync_directory)
}
