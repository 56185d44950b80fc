//! The log on disk: opened, written to, and damaged in a copy.

use std::{
    fs,
    ops::Range,
    path::{Path, PathBuf},
    sync::Arc,
};

use bytes::Bytes;
use tempfile::TempDir;
use wayfold_server::log::{
    Batch, Catalogue, Digest, Durability, Effects, Entry, FjallLog, Journal, LogError, PointStore,
    Uid,
};

use super::{all_points, copied::copied, effects, journal_end::newest_journal, submit, synced};

pub(crate) fn open(directory: &Path) -> FjallLog {
    open_at(directory, Durability::Fsync)
}

pub(crate) fn open_at(directory: &Path, durability: Durability) -> FjallLog {
    FjallLog::open(directory, durability).unwrap()
}

pub(crate) fn append(log: &FjallLog, uid: Uid, revision: u64) {
    let appended = submit(log, uid, revision - 1, effects(revision, &[revision], &[]));
    assert_eq!(appended.unwrap().revision(), revision);
}

pub(crate) fn append_synced(log: &FjallLog, uid: Uid, revision: u64) {
    append(log, uid, revision);
    synced(log, uid, revision).unwrap();
}

/// The index of this name.
pub(crate) fn index(log: &FjallLog, name: &str) -> Entry {
    let indexes = log.indexes().unwrap();
    let mut named = indexes.into_iter().filter(|entry| entry.name == name);
    named.next().unwrap()
}

/// The effects with a batch of a session.
pub(crate) fn with_batch(
    mut effects: Effects,
    (session, number): (u64, u64),
    reserved: Range<u64>,
    ended: &[u64],
) -> Effects {
    effects.set_batch(Some(Arc::new(Batch {
        session,
        number,
        fingerprint: [session as u8; 32],
        response: Bytes::from(format!("batch {number} of {session}")),
        reserved,
        ended: ended.into(),
    })));
    effects
}

/// Copies the directory beside these tests that a server of this version wrote.
pub(crate) fn of_version(version: u32) -> TempDir {
    let kept = format!("{}/tests/log/version-{version}", env!("CARGO_MANIFEST_DIR"));
    let copy = copied(Path::new(&kept));
    // git keeps no empty directory.
    for tree in ["0", "1"] {
        let tree = copy.path().join("store/keyspaces").join(tree);
        fs::create_dir_all(tree.join("tables")).unwrap();
    }
    let line = format!("wayfold-server data, version {version}\n");
    assert_eq!(marker(copy.path()), line);
    copy
}

/// The line that names the version of a directory.
pub(crate) fn marker(directory: &Path) -> String {
    fs::read_to_string(directory.join("wayfold-data")).unwrap()
}

/// The content of a log that has lost nothing. The numbers of a point are its id, revision, modified and tag; those
/// of a session its id, batch and time of use. A record has its revision, the previous digest, its digest, the stored
/// points, the removed ids, and the ended sessions if it has a batch.
pub(crate) fn dump(log: &FjallLog) -> String {
    assert_eq!((log.lost(), log.failure()), (Vec::new(), None));
    let hex = |digest: &Digest| digest.map(|byte| format!("{byte:02x}")).concat();
    let mut text = String::new();
    let mut indexes = log.indexes().unwrap();
    indexes.sort_by(|one, other| one.name.cmp(&other.name));
    for it in indexes {
        let (uid, view) = (it.uid, log.view(it.uid).unwrap());
        let encoding = it.payload_encoding.as_str_name();
        text += &format!("index {} {uid} {} {encoding}\n", it.name, it.space);
        text += &format!("revision {}, next id {}\n", view.revision(), view.next_id());
        for it in all_points(&*view).values() {
            let numbers = [it.id, it.revision, it.modified, it.tag];
            text += &format!("point {numbers:?} {:?} {:?}\n", it.state, it.payload);
        }
        for (id, it) in view.sessions().iter() {
            let (numbers, fingerprint) = ([id, it.batch, it.used_ms], hex(&it.fingerprint));
            text += &format!("session {numbers:?} {fingerprint} {:?}\n", it.response);
        }
        for (first, block) in view.sessions().blocks() {
            text += &format!("block {first}..{} {}\n", block.end, block.session);
        }
        for it in log.operations(uid).unwrap() {
            let fingerprint = hex(&it.fingerprint);
            text += &format!("operation {} {fingerprint} {:?}\n", it.id, it.response);
        }
        for it in log.read(uid, None, usize::MAX).unwrap() {
            let (effects, digests) = (it.effects(), [it.previous(), it.digest()].map(hex));
            let ids = effects.stored().ids().iter().enumerate();
            let stored: Vec<_> = ids.map(|(at, id)| (id, effects.payload(at))).collect();
            let ended = effects.batch().map(|batch| &batch.ended);
            let (revision, changes) = (it.revision(), (stored, effects.removed(), ended));
            text += &format!("record {revision} {} {changes:?}\n", digests.join(" "));
        }
    }
    text
}

/// Asserts that only this index is lost, and returns the reason.
pub(crate) fn only_gone(log: &FjallLog, entry: &Entry) -> LogError {
    let mut gone = log.lost();
    let names: Vec<_> = gone.iter().map(|gone| (&*gone.name, gone.uid)).collect();
    assert_eq!(names, [(&*entry.name, entry.uid)]);
    gone.remove(0).why
}

/// The newest journal of fjall in a directory.
pub(crate) struct JournalFile<'a> {
    directory: &'a Path,
    /// Its path in the directory.
    pub(crate) name: PathBuf,
    /// The number of bytes written to it.
    pub(crate) used: u64,
}

impl<'a> JournalFile<'a> {
    pub(crate) fn of(directory: &'a Path) -> Self {
        let (path, used) = newest_journal(&directory.join("store"));
        Self {
            directory,
            name: path.strip_prefix(directory).unwrap().into(),
            used,
        }
    }

    /// A copy of the directory in which the journal has this length.
    pub(crate) fn cut(&self, length: u64) -> TempDir {
        let copy = copied(self.directory);
        let file = fs::File::options()
            .write(true)
            .open(copy.path().join(&self.name));
        file.unwrap().set_len(length).unwrap();
        copy
    }
}

/// A part of a directory that can be removed and put back.
pub(crate) struct Part {
    path: PathBuf,
    away: PathBuf,
}

impl Part {
    pub(crate) fn of(directory: &Path, name: impl AsRef<Path>) -> Self {
        Self {
            path: directory.join(name),
            away: directory.join("away"),
        }
    }

    pub(crate) fn take_away(&self) {
        fs::rename(&self.path, &self.away).unwrap();
    }

    pub(crate) fn bring_back(&self) {
        fs::rename(&self.away, &self.path).unwrap();
    }
}
