//! Sync marks: the last synced revision of each index, in a file next to the store. fjall silently cuts its journal at
//! an entry that it cannot read; a mark ahead of its index reveals the loss.
//!
//! The file has 128 bytes for each index that ever existed, at 128 times its number: uid, revision, the digest of that
//! revision's record, the length of the name (its highest bit says that the index was deleted), the name, zeros, and a
//! checksum over the number and all of these. So the name of a lost index is known. A mark is written after its
//! revision was synced, so it may be behind the synced state but is never ahead of it. The file is not synced with
//! every mark: after a power loss its marks may be older, and a torn mark is ignored.

use std::{
    collections::BTreeMap,
    fs::File,
    io::{self, Read, Seek, SeekFrom, Write},
    path::Path,
    sync::Arc,
};

use super::layout::{Number, seal, unseal};
use crate::log::{Digest, Uid, cursor::Cursor};

pub(super) const SIZE: usize = 128;
/// The maximum bytes of a name, which the contract fixes.
const NAME: usize = 63;
/// Set in the byte of the name's length.
const DELETED: u8 = 0x80;

/// The last synced revision of an index, or its deletion.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Mark {
    pub(super) uid: Uid,
    pub(super) name: Arc<str>,
    pub(super) revision: u64,
    /// The digest of the record of `revision`.
    pub(super) digest: Digest,
    /// True if the deletion was synced: all remaining keys of the index are removed.
    pub(super) deleted: bool,
}

impl Mark {
    /// The mark of a deleted index.
    pub(super) fn of_deleted() -> Self {
        Self {
            uid: Uid::from_bytes([0; 16]),
            name: "".into(),
            revision: 0,
            digest: [0; 32],
            deleted: true,
        }
    }
}

/// The file of marks.
pub(super) struct Marks(File);

impl Marks {
    /// Opens or creates the file, and returns its marks.
    pub(super) fn open(path: &Path) -> io::Result<(Self, BTreeMap<Number, Mark>)> {
        let mut file = File::options()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(path)?;
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes)?;
        let marks = (0..).zip(bytes.chunks(SIZE));
        let marks = marks.filter_map(|(number, bytes)| Some((number, decode(number, bytes)?)));
        Ok((Self(file), marks.collect()))
    }

    /// Writes marks. If an index has several, the last one counts.
    pub(super) fn write<'a>(
        &mut self,
        marks: impl IntoIterator<Item = (Number, &'a Mark)>,
    ) -> io::Result<()> {
        let newest: BTreeMap<Number, &Mark> = marks.into_iter().collect();
        for (number, mark) in newest {
            self.put(number, &encode(number, mark))?;
        }
        Ok(())
    }

    /// Marks an index as deleted, durably. A mark is never removed: without it, a journal that is cut short would bring
    /// the index back unnoticed.
    pub(super) fn delete(&mut self, number: Number) -> io::Result<()> {
        self.put(number, &encode(number, &Mark::of_deleted()))?;
        self.0.sync_data()
    }

    fn put(&mut self, number: Number, bytes: &[u8]) -> io::Result<()> {
        self.0
            .seek(SeekFrom::Start(u64::from(number) * SIZE as u64))?;
        self.0.write_all(bytes)
    }
}

pub(super) fn encode(number: Number, mark: &Mark) -> Vec<u8> {
    let mut bytes = mark.uid.as_bytes().to_vec();
    bytes.extend_from_slice(&mark.revision.to_le_bytes());
    bytes.extend_from_slice(&mark.digest);
    let name = &mark.name.as_bytes()[..mark.name.len().min(NAME)];
    let flag = if mark.deleted { DELETED } else { 0 };
    bytes.push(name.len() as u8 | flag);
    bytes.extend_from_slice(name);
    bytes.resize(SIZE - 8, 0);
    seal(&number.to_be_bytes(), bytes)
}

pub(super) fn decode(number: Number, bytes: &[u8]) -> Option<Mark> {
    let mut cursor = Cursor::new(unseal(&number.to_be_bytes(), bytes)?);
    let (uid, revision, digest) = (cursor.array()?, cursor.u64()?, cursor.array()?);
    let [length] = cursor.array()?;
    let name = cursor.take((length & !DELETED).into())?;
    let name = str::from_utf8(name).ok()?;
    Some(Mark {
        uid: Uid::from_bytes(uid),
        name: name.into(),
        revision,
        digest,
        deleted: length & DELETED > 0,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn marks_are_found_again_and_torn_ones_are_not() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("marks");
        let mark = |revision| Mark {
            uid: Uid::from_bytes([1; 16]),
            name: "arm".into(),
            revision,
            digest: [2; 32],
            deleted: false,
        };
        let (mut marks, found) = Marks::open(&path).unwrap();
        assert!(found.is_empty());
        marks
            .write([(3, &mark(1)), (0, &mark(5)), (3, &mark(2)), (4, &mark(9))])
            .unwrap();
        marks.delete(0).unwrap();
        let mut bytes = std::fs::read(&path).unwrap();
        bytes[4 * SIZE + 20] ^= 1;
        std::fs::write(&path, bytes).unwrap();
        let (_, found) = Marks::open(&path).unwrap();
        let deleted = Mark::of_deleted();
        assert_eq!(found, BTreeMap::from([(0, deleted), (3, mark(2))]));
    }
}
