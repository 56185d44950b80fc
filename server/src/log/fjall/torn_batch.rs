//! Cuts a torn batch off the end of the journal.
//!
//! A power loss during a write leaves holes: sectors of zeros before sectors that reached the disk. fjall cuts its
//! journal at an entry that it cannot decode. If the hole is inside a value, every entry decodes and only the checksum
//! of the batch differs. fjall then opens nothing. [`open`] cuts the journal at the beginning of that batch.
//!
//! It cuts only a batch that has a hole and is the last one of the journal. A whole batch after it may have been
//! acknowledged, so the journal then stays as it is. It also stays after other damage, which no write leaves. If the
//! batch was synced, the disk itself has made the hole, and the sync marks name the index as lost if they reached the disk.
//!
//! A batch is a start, its items and an end, uncompressed. Numbers are little-endian.
//!
//! | entry | bytes |
//! |---|---|
//! | start | 1, number of items (u32), sequence number (u64) |
//! | item | 2, kind, 0, keyspace (u64), length of the key (u16), length of the value (u32) twice, key, value |
//! | end | 3, XXH3 of the items (u64), [`TRAILER`] |

use std::{
    fs::File,
    io::{self, BufRead, BufReader, ErrorKind, Read, Seek, SeekFrom},
    ops::Range,
    path::{Path, PathBuf},
};

use fjall::{Error, JournalRecoveryError as RecoveryError};
use tracing::warn;
use xxhash_rust::xxh3::Xxh3;

use super::{
    STORE, StoreOptions,
    directory::{Directory, sync_directory},
    journal,
    store::Store,
    unclean_marker,
};

const START: u8 = 1;
const ITEM: u8 = 2;
const END: u8 = 3;
const TRAILER: &[u8; 4] = b"FJL\x03";
/// The greatest kind of an item: a value, a removal, a weak removal.
const MAX_KIND: u8 = 2;

/// A disk writes a sector whole or not at all.
const SECTOR_BYTES: u64 = 512;
/// A hole has at least this many zeros, the last of them at the end of a sector. Its first sector may have been written
/// before the batch was whole.
const MIN_HOLE_BYTES: u64 = 64;

/// The file in the data directory with the bytes that were cut off last.
const CUT: &str = "journal-cut";

/// The last batch of the journal.
struct TornBatch {
    file: PathBuf,
    start: u64,
    /// The offset after the last byte of the file that is not zero.
    end: u64,
}

/// Opens the store of a data directory. If only a torn batch prevents that, cuts it off.
pub(super) fn open(
    directory: &Directory,
    options: impl Into<StoreOptions>,
) -> fjall::Result<Store> {
    let (store, options) = (directory.join(STORE), options.into());
    let opened = Store::open(&store, options);
    let Err(Error::JournalRecovery(RecoveryError::ChecksumMismatch)) = opened else {
        return opened;
    };
    match cut(directory) {
        Ok(Some(torn)) => {
            warn!(
                file = %torn.file.display(), bytes = torn.end - torn.start, kept = CUT,
                "the last write to the journal was torn: it is cut off"
            );
            Store::open(&store, options)
        }
        Ok(None) => opened,
        // It is a failure of the disk like others, and a later attempt may succeed.
        Err(error) => Err(Error::Io(error)),
    }
}

/// Cuts the torn batch off the journal and keeps its bytes. Returns None if nothing was cut.
fn cut(directory: &Directory) -> io::Result<Option<TornBatch>> {
    // A server without fsync writes no marks while it runs. Its indices get new uids after a power loss, and only that
    // tears a batch.
    let path = directory.path();
    if unclean_marker::was_begun(path)? && !unclean_marker::may_have_lost(path)? {
        return Ok(None);
    }
    let Some(torn) = find(&directory.join(STORE))? else {
        return Ok(None);
    };
    let mut file = File::options().read(true).write(true).open(&torn.file)?;
    file.seek(SeekFrom::Start(torn.start))?;
    let mut kept = File::create(directory.join(CUT))?;
    io::copy(&mut file.by_ref().take(torn.end - torn.start), &mut kept)?;
    kept.sync_all()?;
    sync_directory(path)?;
    file.set_len(torn.start)?;
    file.sync_all()?;
    Ok(Some(torn))
}

/// The torn batch at the end of a journal; None if there is none, or if the journal has other damage.
fn find(store: &Path) -> io::Result<Option<TornBatch>> {
    let mut files = journal::files(store)?;
    files.sort_by_key(|file| journal::number(file.file_name()?.to_str()?));
    let Some(newest) = files.pop() else {
        return Ok(None);
    };
    for file in files {
        if damaged_batch(&file)?.is_some() {
            return Ok(None);
        }
    }
    damaged_batch(&newest)?.map_or(Ok(None), |batch| torn_batch(newest, batch))
}

/// The damaged batch if it has a hole and no whole batch follows it.
fn torn_batch(path: PathBuf, batch: Range<u64>) -> io::Result<Option<TornBatch>> {
    let mut file = File::open(&path)?;
    file.seek(SeekFrom::Start(batch.start))?;
    let (mut at, mut end) = (batch.start, batch.start);
    let (mut zeros, mut has_hole, mut matched) = (0, false, 0);
    for byte in BufReader::new(file).bytes() {
        let byte = byte?;
        at += 1;
        (zeros, end) = if byte == 0 { (zeros + 1, end) } else { (0, at) };
        if at <= batch.end {
            has_hole |= zeros >= MIN_HOLE_BYTES && at.is_multiple_of(SECTOR_BYTES);
            continue;
        }
        matched = match byte == TRAILER[matched] {
            true => matched + 1,
            false => usize::from(byte == TRAILER[0]),
        };
        if matched == TRAILER.len() {
            return Ok(None);
        }
    }
    Ok(has_hole.then_some(TornBatch {
        file: path,
        start: batch.start,
        end,
    }))
}

/// The first batch of a file whose entries decode and whose checksum differs.
fn damaged_batch(path: &Path) -> io::Result<Option<Range<u64>>> {
    let mut reader = BatchReader {
        file: BufReader::new(File::open(path)?),
        at: 0,
        sum: Xxh3::new(),
    };
    loop {
        let start = reader.at;
        match reader.next_is_whole() {
            Ok(Some(true)) => {}
            Ok(Some(false)) => return Ok(Some(start..reader.at)),
            Ok(None) => return Ok(None),
            Err(error) if error.kind() == ErrorKind::UnexpectedEof => return Ok(None),
            Err(error) => return Err(error),
        }
    }
}

/// Reads a file of the journal as fjall does, without keeping its content.
struct BatchReader {
    file: BufReader<File>,
    /// The number of bytes that were read.
    at: u64,
    /// The checksum of the bytes since the last start.
    sum: Xxh3,
}

impl BatchReader {
    /// True if the checksum of the next batch matches, false if it differs; None if a part of it does not decode.
    fn next_is_whole(&mut self) -> io::Result<Option<bool>> {
        let [tag] = self.array()?;
        if tag != START {
            return Ok(None);
        }
        let mut left = u32::from_le_bytes(self.array()?);
        let _sequence_number: [u8; 8] = self.array()?;
        self.sum = Xxh3::new();
        loop {
            let sum = self.sum.digest();
            match self.array()? {
                [ITEM] if left > 0 => {
                    left -= 1;
                    if !self.skip_item()? {
                        return Ok(None);
                    }
                }
                [END] if left == 0 => {
                    let expected = u64::from_le_bytes(self.array()?);
                    let trailer: [u8; 4] = self.array()?;
                    return Ok((trailer == *TRAILER).then_some(sum == expected));
                }
                _ => return Ok(None),
            }
        }
    }

    /// Skips the rest of an item after its first byte; false if it does not decode.
    fn skip_item(&mut self) -> io::Result<bool> {
        let [kind, compression] = self.array()?;
        let _keyspace: [u8; 8] = self.array()?;
        let key = u16::from_le_bytes(self.array()?);
        let value = u32::from_le_bytes(self.array()?);
        let stored = u32::from_le_bytes(self.array()?);
        if kind > MAX_KIND || compression != 0 || stored != value {
            return Ok(false);
        }
        self.skip(u64::from(key) + u64::from(value))?;
        Ok(true)
    }

    fn array<const N: usize>(&mut self) -> io::Result<[u8; N]> {
        let mut bytes = [0; N];
        self.file.read_exact(&mut bytes)?;
        self.sum.update(&bytes);
        self.at += N as u64;
        Ok(bytes)
    }

    fn skip(&mut self, mut left: u64) -> io::Result<()> {
        while left > 0 {
            let read = self.file.fill_buf()?;
            let skipped = (read.len() as u64).min(left);
            if skipped == 0 {
                return Err(ErrorKind::UnexpectedEof.into());
            }
            self.sum.update(&read[..skipped as usize]);
            self.file.consume(skipped as usize);
            self.at += skipped;
            left -= skipped;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
