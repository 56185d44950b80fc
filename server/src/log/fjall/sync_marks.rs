//! Sync marks: the last synced revision of each index, in a file next to the store. fjall silently cuts its journal at
//! an entry that it cannot read; a mark ahead of its index reveals the loss.
//!
//! The file has slots of 128 bytes, one for the number of each index: uid, revision, the digest of that revision's
//! record, the length of the name (its highest bit says that the index was deleted), the name, zeros, and a checksum
//! over the number and all of these. So the name of a lost index is known. A mark is written after its revision was
//! synced, so it may be behind the synced state but is never ahead of it. The file is not synced with every mark: after
//! a power loss its marks may be older, and a torn mark is ignored.
//!
//! A start rewrites a file that is mostly marks of deleted indices. It then begins with two copies of a [`Layout`]: a
//! *floor*, and the numbers below it that have slots. Every other number below the floor is of a deleted index. A file
//! without a layout has a slot for every number from 0 on.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs::{self, File},
    io::{self, Read, Seek, SeekFrom, Write},
    path::Path,
    sync::Arc,
};

use super::{
    directory::sync_directory,
    layout::{Number, seal, unseal},
};
use crate::log::{Digest, MAX_NAME_BYTES, Uid, cursor::Cursor};

pub(super) const SLOT_BYTES: usize = 128;
/// Set in the byte of the name's length.
const DELETED: u8 = 0x80;
/// The beginning of a layout. No uid is equal to it.
const LAYOUT: &[u8; 16] = b"wayfold marks 2\n";
/// A file is rewritten if it has more slots than this, and more than twice the slots that are used.
const MAX_UNUSED_SLOTS: usize = 64;

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

/// The slots of a file.
#[derive(Clone, Debug, Default, PartialEq)]
struct Layout {
    /// From this number on, every number has a slot.
    floor: Number,
    /// The numbers below the floor that have slots, ascending.
    kept: Vec<Number>,
    /// The bytes before the first slot.
    start: usize,
}

impl Layout {
    fn new(floor: Number, kept: Vec<Number>) -> Self {
        // Each of the two copies fills whole slots: 16 bytes, two numbers, the kept ones, and a checksum.
        let copy = (16 + 4 + 4 + 4 * kept.len() + 8).next_multiple_of(SLOT_BYTES);
        let start = 2 * copy;
        Self { floor, kept, start }
    }

    /// The two copies.
    fn encode(&self) -> Vec<u8> {
        let mut bytes = LAYOUT.to_vec();
        for number in [self.floor, self.kept.len() as Number]
            .iter()
            .chain(&self.kept)
        {
            bytes.extend_from_slice(&number.to_le_bytes());
        }
        bytes.resize(self.start / 2 - 8, 0);
        seal(LAYOUT, bytes).repeat(2)
    }

    fn decode(bytes: &[u8]) -> Option<Self> {
        // Checked first, because a file without a layout is searched for one, slot by slot.
        bytes.starts_with(LAYOUT).then_some(())?;
        let mut cursor = Cursor::new(unseal(LAYOUT, bytes)?.strip_prefix(LAYOUT)?);
        let mut number = || cursor.array().map(Number::from_le_bytes);
        let (floor, count) = (number()?, number()?);
        let kept: Option<Vec<Number>> = (0..count).map(|_| number()).collect();
        Some(Self::new(floor, kept?))
    }

    /// The layout of a file: that of its first intact copy.
    fn of(bytes: &[u8]) -> Self {
        // The second copy begins where the first one ends.
        let lengths = (SLOT_BYTES..=bytes.len() / 2).step_by(SLOT_BYTES);
        let found = lengths.flat_map(|length| [0, length].map(|start| &bytes[start..][..length]));
        let found = found.filter_map(Self::decode).next();
        found.unwrap_or_default()
    }

    /// The number of the slot at an index.
    fn number(&self, slot: usize) -> Number {
        let kept = self.kept.get(slot).copied();
        kept.unwrap_or_else(|| self.floor + (slot - self.kept.len()) as Number)
    }

    /// The offset of a number's slot; None if it has none.
    fn offset(&self, number: Number) -> Option<u64> {
        let slot = match number.checked_sub(self.floor) {
            Some(above) => self.kept.len() + above as usize,
            None => self.kept.binary_search(&number).ok()?,
        };
        Some((self.start + slot * SLOT_BYTES) as u64)
    }
}

/// The content of a file of marks.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct MarkTable {
    layout: Layout,
    marks: BTreeMap<Number, Mark>,
}

impl MarkTable {
    fn read(bytes: &[u8]) -> Self {
        let layout = Layout::of(bytes);
        let slots = bytes.get(layout.start..).unwrap_or_default();
        let slots = slots.chunks(SLOT_BYTES).enumerate();
        let marks = slots.filter_map(|(slot, bytes)| {
            let number = layout.number(slot);
            Some((number, decode(number, bytes)?))
        });
        Self {
            marks: marks.collect(),
            layout,
        }
    }

    pub(super) fn get(&self, number: Number) -> Option<&Mark> {
        self.marks.get(&number)
    }

    /// True if the index of this number was deleted.
    pub(super) fn is_deleted(&self, number: Number) -> bool {
        match self.get(number) {
            Some(mark) => mark.deleted,
            None => self.layout.offset(number).is_none(),
        }
    }

    /// True if the number has a mark or is of a deleted index.
    pub(super) fn is_marked(&self, number: Number) -> bool {
        self.marks.contains_key(&number) || self.is_deleted(number)
    }

    /// The marks of the indices that were not deleted.
    pub(super) fn live(&self) -> impl Iterator<Item = (Number, &Mark)> {
        let live = self.marks.iter().filter(|(_, mark)| !mark.deleted);
        live.map(|(number, mark)| (*number, mark))
    }

    /// The number after all that are known.
    pub(super) fn next(&self) -> Number {
        let last = self.marks.keys().next_back();
        last.map_or(0, |last| last + 1).max(self.layout.floor)
    }

    /// True if it names no index.
    pub(super) fn is_empty(&self) -> bool {
        self.next() == 0
    }
}

pub(super) struct Marks {
    file: File,
    layout: Layout,
}

impl Marks {
    /// Opens or creates the file, and returns its marks.
    pub(super) fn open(path: &Path) -> io::Result<(Self, MarkTable)> {
        let mut file = File::options()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(path)?;
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes)?;
        let marked = MarkTable::read(&bytes);
        let layout = marked.layout.clone();
        Ok((Self { file, layout }, marked))
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

    /// Marks an index as deleted, durably. Without the mark, a journal that is cut short would bring the index back
    /// unnoticed.
    pub(super) fn delete(&mut self, number: Number) -> io::Result<()> {
        let mark = Mark {
            uid: Uid::from_bytes([0; 16]),
            name: "".into(),
            revision: 0,
            digest: [0; 32],
            deleted: true,
        };
        self.put(number, &encode(number, &mark))?;
        self.file.sync_data()
    }

    /// Writes the slot of a number; a number without one stays deleted.
    fn put(&mut self, number: Number, bytes: &[u8]) -> io::Result<()> {
        let Some(offset) = self.layout.offset(number) else {
            return Ok(());
        };
        self.file.seek(SeekFrom::Start(offset))?;
        self.file.write_all(bytes)
    }

    /// Rewrites a file with many slots that are not used: `kept` are the numbers below `floor` that need one, and all
    /// others below it are of deleted indices. Nothing else may have the file open.
    pub(super) fn compact(
        self,
        path: &Path,
        floor: Number,
        kept: &BTreeSet<Number>,
    ) -> io::Result<Self> {
        let bytes = fs::read(path)?;
        let slots = bytes.len().saturating_sub(self.layout.start) / SLOT_BYTES;
        if slots <= MAX_UNUSED_SLOTS.max(2 * kept.len()) {
            return Ok(self);
        }
        let marked = MarkTable::read(&bytes);
        let layout = Layout::new(floor, kept.iter().copied().collect());
        let mut rewritten = layout.encode();
        for &number in kept {
            let mark = marked.get(number).map(|mark| encode(number, mark));
            rewritten.extend(mark.unwrap_or_else(|| vec![0; SLOT_BYTES]));
        }
        let new = path.with_extension("new");
        let mut file = File::create(&new)?;
        file.write_all(&rewritten)?;
        file.sync_all()?;
        fs::rename(&new, path)?;
        sync_directory(path.parent().unwrap_or(path))?;
        Ok(Self::open(path)?.0)
    }
}

pub(super) fn encode(number: Number, mark: &Mark) -> Vec<u8> {
    let mut bytes = mark.uid.as_bytes().to_vec();
    bytes.extend_from_slice(&mark.revision.to_le_bytes());
    bytes.extend_from_slice(&mark.digest);
    let name = &mark.name.as_bytes()[..mark.name.len().min(MAX_NAME_BYTES)];
    let flag = if mark.deleted { DELETED } else { 0 };
    bytes.push(name.len() as u8 | flag);
    bytes.extend_from_slice(name);
    bytes.resize(SLOT_BYTES - 8, 0);
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

    fn mark(revision: u64) -> Mark {
        Mark {
            uid: Uid::from_bytes([1; 16]),
            name: "arm".into(),
            revision,
            digest: [2; 32],
            deleted: false,
        }
    }

    #[test]
    fn marks_are_found_again_and_torn_ones_are_not() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("marks");
        let (mut marks, found) = Marks::open(&path).unwrap();
        assert!(found.is_empty());
        marks
            .write([(3, &mark(1)), (0, &mark(5)), (3, &mark(2)), (4, &mark(9))])
            .unwrap();
        marks.delete(0).unwrap();
        let mut bytes = std::fs::read(&path).unwrap();
        bytes[4 * SLOT_BYTES + 20] ^= 1;
        std::fs::write(&path, bytes).unwrap();
        let (_, found) = Marks::open(&path).unwrap();
        assert_eq!(found.get(3), Some(&mark(2)));
        let numbers = found.live().map(|(number, _)| number);
        assert_eq!(numbers.collect::<Vec<_>>(), [3]);
        assert_eq!(
            [0, 1, 3, 4].map(|it| found.is_deleted(it)),
            [true, false, false, false]
        );
        assert_eq!(found.next(), 4);
    }

    /// A file of the older form, without a floor, has many marks of deleted indices. It is rewritten once, and grows again.
    #[test]
    fn a_rewritten_file_has_a_floor_instead_of_the_marks_of_deleted_indices() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("marks");
        let (mut marks, _) = Marks::open(&path).unwrap();
        for number in 0..200 {
            marks.write([(number, &mark(7))]).unwrap();
            if ![3, 150].contains(&number) {
                marks.delete(number).unwrap();
            }
        }
        let kept = BTreeSet::from([3, 90, 150]);
        let mut marks = marks.compact(&path, 200, &kept).unwrap();
        assert_eq!(fs::metadata(&path).unwrap().len() as usize, 5 * SLOT_BYTES);
        marks
            .write([(150, &mark(8)), (200, &mark(9)), (202, &mark(10))])
            .unwrap();
        // The number of a deleted index.
        marks.write([(20, &mark(11))]).unwrap();
        marks.delete(21).unwrap();
        let whole = fs::read(&path).unwrap();
        let check = |damaged: Option<usize>| {
            let mut bytes = whole.clone();
            if let Some(damaged) = damaged {
                bytes[damaged] ^= 1;
            }
            fs::write(&path, bytes).unwrap();
            Marks::open(&path).unwrap().1
        };
        let found = check(None);
        let live = |found: &MarkTable| -> Vec<(Number, u64)> {
            found
                .live()
                .map(|(number, mark)| (number, mark.revision))
                .collect()
        };
        assert_eq!(live(&found), [(3, 7), (150, 8), (200, 9), (202, 10)]);
        let deleted = (0..205).filter(|number| !found.is_deleted(*number));
        assert_eq!(
            deleted.collect::<Vec<_>>(),
            [3, 150, 200, 201, 202, 203, 204]
        );
        assert_eq!(found.next(), 203);
        // One bit costs at most one mark, and never declares an index deleted.
        for bit in 0..whole.len() {
            let damaged = check(Some(bit));
            assert!(live(&damaged).len() >= 3, "{bit}");
            assert!(
                [3, 150, 200, 202].iter().all(|it| !damaged.is_deleted(*it)),
                "{bit}"
            );
        }
        fs::write(&path, &whole).unwrap();
        let marks = marks.compact(&path, 203, &kept).unwrap();
        assert_eq!(marks.layout.floor, 200, "few slots are unused");
    }
}
