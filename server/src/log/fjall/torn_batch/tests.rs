//! Journals that fjall wrote, with holes and other damage.

use std::fs;

use fjall::PersistMode;
use tempfile::TempDir;

use super::{super::Durability, *};

const PAGE: usize = 4096;
const KEYS: [&str; 3] = ["a", "b", "c"];
const VALUE_BYTES: [usize; 3] = [20_000, 100, 20_000];
/// A page inside the value of the last batch.
const LAST_VALUE: usize = 6 * PAGE;

/// A closed store whose journal has one batch for each key.
struct Written {
    directory: Directory,
    journal: PathBuf,
    bytes: Vec<u8>,
    /// The offset of each batch.
    starts: Vec<usize>,
    _temporary: TempDir,
}

impl Written {
    fn new() -> Self {
        let temporary = tempfile::tempdir().unwrap();
        let directory = Directory::take(temporary.path()).unwrap();
        let mut written = Self {
            journal: directory.join(STORE).join("0.jnl"),
            directory,
            bytes: Vec::new(),
            starts: Vec::new(),
            _temporary: temporary,
        };
        for (key, length) in KEYS.into_iter().zip(VALUE_BYTES) {
            written.starts.push(written.bytes.len());
            let store = written.open().unwrap();
            put(&store, key, length);
            store.close().unwrap();
            // A start removes the preallocated rest of the file.
            written.open().unwrap().close().unwrap();
            written.bytes = fs::read(&written.journal).unwrap();
        }
        written
    }

    fn open(&self) -> fjall::Result<Store> {
        open(&self.directory, Durability::Fsync)
    }

    /// The journal with a page of zeros.
    fn with_hole(&self, at: usize) -> Vec<u8> {
        let mut bytes = self.bytes.clone();
        bytes[at..at + PAGE].fill(0);
        bytes
    }

    /// Opens the store with another journal, expects all batches but the last one, and writes to it again.
    fn check_without_last(&self, bytes: &[u8]) {
        fs::write(&self.journal, bytes).unwrap();
        let store = self.open().unwrap();
        assert_eq!(found(&store), [true, true, false]);
        let length = fs::metadata(&self.journal).unwrap().len();
        assert_eq!(length, self.starts[2] as u64);
        put(&store, "c", 100);
        store.close().unwrap();
        let store = self.open().unwrap();
        assert_eq!(found(&store), [true; 3]);
        store.close().unwrap();
    }

    /// Expects that the store cannot be opened with another journal, and that the journal stays.
    fn check_refused(&self, what: &str, bytes: &[u8]) {
        fs::write(&self.journal, bytes).unwrap();
        let error = self.open().err();
        let mismatch = Some(Error::JournalRecovery(RecoveryError::ChecksumMismatch));
        assert_eq!(format!("{error:?}"), format!("{mismatch:?}"), "{what}");
        assert!(fs::read(&self.journal).unwrap() == bytes, "{what}");
        assert!(!self.directory.join(CUT).exists(), "{what}");
    }
}

fn put(store: &Store, key: &str, length: usize) {
    let handles = store.handles().unwrap();
    handles.keyspace.insert(key, vec![7u8; length]).unwrap();
    handles.database.persist(PersistMode::SyncAll).unwrap();
}

/// The keys that the store has.
fn found(store: &Store) -> [bool; 3] {
    let handles = store.handles().unwrap();
    KEYS.map(|key| handles.keyspace.get(key).unwrap().is_some())
}

#[test]
fn a_last_batch_with_a_hole_is_cut_off_and_kept() {
    let written = Written::new();
    let (start, end) = (written.starts[2], written.bytes.len());
    let kept = written.directory.join(CUT);
    let mut cuts = 0;
    for page in (start / PAGE * PAGE..end).step_by(PAGE) {
        let mut bytes = written.bytes.clone();
        bytes[page.max(start)..end.min(page + PAGE)].fill(0);
        let torn = bytes[start..].to_vec();
        // A new file has a preallocated rest.
        for rest in [0, 2 * PAGE] {
            bytes.resize(end + rest, 0);
            written.check_without_last(&bytes);
            // fjall itself cuts a batch whose start or end is missing.
            if let Ok(cut) = fs::read(&kept) {
                assert!(cut == torn, "{page}");
                fs::remove_file(&kept).unwrap();
                cuts += 1;
            }
        }
    }
    assert_eq!(cuts, 8, "four pages are inside the value");
}

#[test]
fn an_unfinished_batch_is_cut_off() {
    let written = Written::new();
    let (start, end) = (written.starts[2], written.bytes.len());
    for length in (start..end).step_by(997).chain([end - 1]) {
        written.check_without_last(&written.bytes[..length]);
    }
    assert!(!written.directory.join(CUT).exists());
    // It follows a torn one.
    let unfinished = &written.bytes[..2 * PAGE];
    let bytes = [&written.with_hole(LAST_VALUE)[..], unfinished].concat();
    written.check_without_last(&bytes);
    let kept = fs::read(written.directory.join(CUT)).unwrap();
    assert!(kept == bytes[start..]);
}

#[test]
fn other_damage_is_left_as_it_is() {
    let written = Written::new();
    written.check_refused("an earlier batch", &written.with_hole(PAGE));
    let mut flipped = written.bytes.clone();
    flipped[LAST_VALUE] ^= 1;
    written.check_refused("a flipped bit", &flipped);
    let whole = &written.bytes[written.starts[1]..written.starts[2]];
    for gap in [0, 3, PAGE] {
        let gap = vec![0u8; gap];
        let bytes = [&written.with_hole(LAST_VALUE)[..], &gap[..], whole].concat();
        written.check_refused("a whole batch follows", &bytes);
    }
    let newer = written.directory.join(STORE).join("1.jnl");
    fs::write(&newer, vec![0; PAGE]).unwrap();
    written.check_refused("an earlier file", &written.with_hole(LAST_VALUE));
    fs::remove_file(newer).unwrap();
}

/// A server without fsync was killed, and the system still runs.
#[test]
fn without_a_power_loss_a_hole_is_other_damage() {
    let written = Written::new();
    let path = written.directory.path();
    unclean_marker::begin(path, Durability::Os).unwrap();
    let holed = written.with_hole(LAST_VALUE);
    // Only Linux tells whether the system still runs.
    if !unclean_marker::may_have_lost(path).unwrap() {
        written.check_refused("no power loss", &holed);
    }
    unclean_marker::begin(path, Durability::None).unwrap();
    written.check_without_last(&holed);
}
