//! How far each index was synced, beside the store: fjall cuts its journal at an entry that it cannot read, without a
//! word, and this is how that is noticed.
//!
//! The file has 128 bytes for each index that there ever was, at 128 times its number: uid, revision, the digest of that
//! revision's record, the name after its length and before zeros, and a checksum over the number and these. So an index
//! of which nothing else is left can be named. A mark is written after what it speaks of was synced, so it may be behind
//! and is never ahead. The file itself is not synced with every mark: after a loss of power it may
//! be a moment older, and a mark that was torn then says nothing.

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
/// Most bytes of a name: as many as the contract allows.
const NAME: usize = 63;

/// How far an index was synced.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Mark {
    pub(super) uid: Uid,
    pub(super) name: Arc<str>,
    pub(super) revision: u64,
    /// Of the record of `revision`.
    pub(super) digest: Digest,
}

/// The file of marks.
pub(super) struct Marks(File);

impl Marks {
    /// The file, made if there is none, and what it holds.
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

    /// Writes marks; of several for one index the last.
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

    /// Forgets an index, for good.
    pub(super) fn clear(&mut self, number: Number) -> io::Result<()> {
        self.put(number, &[0; SIZE])?;
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
    bytes.push(name.len() as u8);
    bytes.extend_from_slice(name);
    bytes.resize(SIZE - 8, 0);
    seal(&number.to_be_bytes(), bytes)
}

pub(super) fn decode(number: Number, bytes: &[u8]) -> Option<Mark> {
    let mut cursor = Cursor::new(unseal(&number.to_be_bytes(), bytes)?);
    let (uid, revision, digest) = (cursor.array()?, cursor.u64()?, cursor.array()?);
    let [length] = cursor.array()?;
    let name = str::from_utf8(cursor.take(length.into())?).ok()?;
    Some(Mark {
        uid: Uid::from_bytes(uid),
        name: name.into(),
        revision,
        digest,
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
        };
        let (mut marks, found) = Marks::open(&path).unwrap();
        assert!(found.is_empty());
        marks
            .write([(3, &mark(1)), (0, &mark(5)), (3, &mark(2)), (4, &mark(9))])
            .unwrap();
        marks.clear(0).unwrap();
        let mut bytes = std::fs::read(&path).unwrap();
        bytes[4 * SIZE + 20] ^= 1;
        std::fs::write(&path, bytes).unwrap();
        let (_, found) = Marks::open(&path).unwrap();
        assert_eq!(found, BTreeMap::from([(3, mark(2))]));
    }
}
