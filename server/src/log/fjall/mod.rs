//! A log on disk, in the embedded store fjall.
//!
//! A mutation is one batch of the store, which is there whole or not at all: its record, the points as it leaves them,
//! and the head of its index. What is acknowledged depends on [`Durability`]; `fsync` shares one sync among all who
//! write meanwhile (`syncer`).
//!
//! Modules: `directory` (whose the directory is), `layout` and `point` (what the store holds, byte for byte), `index`
//! (one index's writer), `view` (its points, pinned), `journal`, `syncer` and `marks` (what is on disk for certain),
//! `recovery`, `loose` (after a server that does not sync), `sweeper` (what deleted indices leave).

mod directory;
mod index;
mod journal;
mod layout;
mod loose;
mod marks;
mod point;
mod recovery;
mod store;
mod sweeper;
mod syncer;
mod view;

use std::{collections::BTreeMap, fs, io, path::Path, sync::Arc};

use futures_util::{FutureExt, future::BoxFuture};
use parking_lot::{Mutex, RwLock};
use serde::Deserialize;
use tracing::{info, warn};

pub use directory::OpenError;

use super::{Effects, Entry, Log, LogError, Record, Uid, View};
use directory::{Directory, sync_directory};
use index::{Index, State};
use journal::Journal;
use layout::{Named, Number, entry_key};
use marks::{Mark, Marks};
use store::{Store, storage};
use sweeper::Sweeper;
use syncer::Syncer;

const STORE: &str = "store";
/// A store in the making: it takes its name once it is whole.
const NEW_STORE: &str = "store.new";
const MARKS: &str = "marks";

/// What an acknowledged mutation survives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
pub enum Durability {
    /// A loss of power.
    Fsync,
    /// The end of the server's process, whatever ends it.
    Os,
    /// An orderly stop of the server.
    None,
}

impl TryFrom<String> for Durability {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        match name.as_str() {
            "fsync" => Ok(Self::Fsync),
            "os" => Ok(Self::Os),
            "none" => Ok(Self::None),
            _ => Err(format!("\"{name}\" is none of \"fsync\", \"os\", \"none\"")),
        }
    }
}

/// A [`Log`] in a directory.
///
/// Dropping it syncs what was appended; views that are held keep the directory.
pub struct FjallLog {
    // Fields are dropped in this order: the threads end before the directory is given up.
    syncer: Option<Syncer>,
    sweeper: Sweeper,
    indexes: RwLock<BTreeMap<Uid, Arc<Index>>>,
    /// The number of the next index; who holds it creates or deletes one.
    next: Mutex<Number>,
    store: Arc<Store>,
    directory: Directory,
}

impl FjallLog {
    /// Opens the log in `directory`, which is made if there is none.
    pub fn open(directory: &Path, durability: Durability) -> Result<Self, OpenError> {
        let directory = Directory::take(directory)?;
        let failed = |source| OpenError::Io {
            path: directory.path().into(),
            source,
        };
        let unusable = |error: &dyn ToString| OpenError::Store {
            directory: directory.path().into(),
            problem: error.to_string(),
        };
        make_store(&directory).map_err(failed)?;
        let store = Store::open(&directory.join(STORE), durability);
        let store = Arc::new(store.map_err(|error| unusable(&error))?);
        let (marks, marked) = Marks::open(&directory.join(MARKS)).map_err(failed)?;
        let renamed = loose::may_have_lost(directory.path()).map_err(failed)?;
        let found = recovery::recover(&store, &marked, renamed);
        let found = found.map_err(|error| unusable(&error))?;
        let mut journal = Journal::new(store.database.clone(), directory.join(STORE));
        journal.sync().map_err(|error| unusable(&error))?;
        loose::begin(directory.path(), durability).map_err(failed)?;

        let (sweeping, _) = Marks::open(&directory.join(MARKS)).map_err(failed)?;
        let sweeper = Sweeper::start(Arc::clone(&store), sweeping).map_err(failed)?;
        let syncer = match durability {
            Durability::Fsync => Some(Syncer::start(journal, marks).map_err(failed)?),
            Durability::Os | Durability::None => None,
        };
        for &number in &found.deleted {
            sweeper.sweep(number);
        }
        info!(
            directory = %directory.path().display(),
            indexes = found.indexes.len(),
            "opened the log"
        );
        let indexes = found.indexes.into_iter();
        Ok(Self {
            syncer,
            sweeper,
            indexes: RwLock::new(indexes.map(|index| (index.entry.uid, index)).collect()),
            next: Mutex::new(found.next),
            store,
            directory,
        })
    }

    fn index(&self, uid: Uid) -> Result<Arc<Index>, LogError> {
        match self.indexes.read().get(&uid) {
            Some(index) => Ok(Arc::clone(index)),
            None => Err(LogError::UnknownIndex { uid }),
        }
    }

    /// Announces a batch that was committed.
    fn written(&self, number: Number, mark: Mark) {
        if let Some(syncer) = &self.syncer {
            syncer.written(number, mark);
        }
    }

    /// Stores an index's entry, for certain.
    fn put(&self, number: Number, named: &Named, mark: Mark) -> Result<(), LogError> {
        let mut batch = self.store.database.batch();
        batch.insert(
            &self.store.keyspace,
            entry_key(number),
            named.encode(number),
        );
        batch.commit().map_err(storage)?;
        self.written(number, mark);
        match &self.syncer {
            Some(syncer) => syncer.wait(),
            None => Ok(()),
        }
    }

    /// Notes that all there is was synced.
    fn settle(&self) -> Result<(), String> {
        Journal::new(self.store.database.clone(), self.directory.join(STORE)).sync()?;
        let indexes = self.indexes.read();
        let marks = indexes
            .values()
            .filter_map(|index| Some((index.number, index.mark()?)));
        let settled = Marks::open(&self.directory.join(MARKS))
            .and_then(|(mut file, _)| file.write(&marks.collect::<Vec<_>>()))
            .and_then(|()| loose::end(self.directory.path()));
        settled.map_err(|error| error.to_string())
    }
}

impl Drop for FjallLog {
    fn drop(&mut self) {
        if self.syncer.is_none()
            && let Err(error) = self.settle()
        {
            warn!(
                error,
                "could not sync the log; the next start takes mutations for lost"
            );
        }
    }
}

impl Log for FjallLog {
    fn indexes(&self) -> Result<Vec<Entry>, LogError> {
        let indexes = self.indexes.read();
        Ok(indexes.values().map(|index| index.entry.clone()).collect())
    }

    fn create(&self, entry: Entry) -> Result<(), LogError> {
        let mut next = self.next.lock();
        if self.indexes.read().contains_key(&entry.uid) {
            return Err(LogError::UidTaken { uid: entry.uid });
        }
        let number = *next;
        let index = Index::new(number, entry.clone(), State::empty());
        *next += 1;
        let mark = Mark {
            uid: entry.uid,
            revision: 0,
            digest: Record::NO_PREVIOUS,
        };
        let deleted = false;
        self.put(number, &Named { entry, deleted }, mark)?;
        self.indexes.write().insert(index.entry.uid, index);
        Ok(())
    }

    fn delete(&self, uid: Uid) -> Result<(), LogError> {
        let _alone = self.next.lock();
        let index = self.index(uid)?;
        let number = index.number;
        let mark = index.close(LogError::UnknownIndex { uid });
        let named = Named {
            entry: index.entry.clone(),
            deleted: true,
        };
        if let Err(why) = self.put(number, &named, mark) {
            index.close(why.clone());
            return Err(why);
        }
        self.indexes.write().remove(&uid);
        self.sweeper.sweep(number);
        Ok(())
    }

    fn append(&self, uid: Uid, expected: u64, effects: Effects) -> Result<Arc<Record>, LogError> {
        if let Some(why) = self.syncer.as_ref().and_then(Syncer::failure) {
            return Err(why);
        }
        let index = self.index(uid)?;
        index.append(&self.store, expected, effects, |mark| {
            self.written(index.number, mark);
        })
    }

    fn synced(&self, _uid: Uid, _revision: u64) -> BoxFuture<'static, Result<(), LogError>> {
        match &self.syncer {
            Some(syncer) => syncer.synced(),
            None => std::future::ready(Ok(())).boxed(),
        }
    }

    fn tail(&self, uid: Uid, after: Option<u64>) -> Result<Vec<Arc<Record>>, LogError> {
        self.index(uid)?.tail(&self.store, after)
    }

    fn points(&self, uid: Uid) -> Result<Arc<dyn View>, LogError> {
        self.index(uid)?.pin(&self.store)
    }

    fn trim(&self, uid: Uid, keep_bytes: usize) -> Result<(), LogError> {
        self.index(uid)?.trim(keep_bytes)
    }
}

/// Makes the store, unless there is one. A start that is cut short leaves none, or a whole one.
fn make_store(directory: &Directory) -> io::Result<()> {
    let (store, new) = (directory.join(STORE), directory.join(NEW_STORE));
    if store.try_exists()? {
        return Ok(());
    }
    if new.try_exists()? {
        fs::remove_dir_all(&new)?;
    }
    let made = Store::open(&new, Durability::Fsync).map_err(io::Error::other)?;
    let synced = Journal::new(made.database.clone(), new.clone()).sync();
    synced.map_err(io::Error::other)?;
    drop(made);
    fs::rename(&new, &store)?;
    sync_directory(directory.path())
}
