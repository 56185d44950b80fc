//! A log on disk, in the embedded store fjall.
//!
//! A mutation is one batch of the store, which is there whole or not at all: its record, the points as it leaves them,
//! and the head of its index. What is acknowledged depends on [`Durability`]; `fsync` shares one sync among all who
//! write meanwhile (`syncer`).
//!
//! Modules: `directory` (whose the directory is), `engine` and `store` (the store while it is open), `manifest` and `manifest_copy` (before
//! it is opened), `layout` and `point` (what it holds, byte for byte), `index` (one index's writer), `view` (its points,
//! pinned), `restoring` (an index made from a copy), `journal`, `syncer` and `marks` (what is on disk for certain),
//! `failure` (why nothing more is written), `recovery`, `making` (a store that is damaged is made anew), `loose` (after a
//! server that does not sync), `sweeper` (what deleted indices leave).
//!
//! A store that has failed takes nothing any more and is read still. It is closed and opened anew as a whole
//! ([`Log::reopen`]), by the same way as at the start: there is no other that leads from the files to the state.

mod directory;
mod engine;
mod failure;
#[cfg(fuzzing)]
pub mod fuzzing;
mod index;
mod journal;
mod layout;
mod loose;
mod making;
mod manifest;
mod manifest_copy;
mod marks;
mod point;
mod recovery;
mod restoring;
mod store;
mod sweeper;
mod syncer;
mod view;

use std::{collections::BTreeMap, io, path::Path, sync::Arc};

use futures_util::{FutureExt, future::BoxFuture};
use parking_lot::{Mutex, RwLock};
use serde::Deserialize;
use tracing::{error, info};

pub use directory::OpenError;

use super::{
    Effects, Entry, Gone, Keep, Log, LogError, Operation, Origin, Record, Restoring, Uid, View,
};
use directory::Directory;
use engine::Engine;
use failure::is_untold;
use layout::Number;
use making::Remade;
use marks::{Mark, Marks};
use store::shut;

const STORE: &str = "store";
/// A store in the making: it takes its name once it is whole.
const NEW_STORE: &str = "store.new";
/// A store that was made anew, and is about to replace the damaged one.
const REMADE_STORE: &str = "store.remade";
/// With a number after it: stores that were damaged, as they were before they were made anew.
const DAMAGED_STORE: &str = "store.damaged-";
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
/// Dropping it syncs what was appended, and closes the views that are held.
pub struct FjallLog {
    // Dropped before the directory is given up.
    opened: RwLock<Opened>,
    /// Held by who opens the store anew.
    reopening: Mutex<Suspicion>,
    durability: Durability,
    directory: Arc<Directory>,
}

/// What a store that failed may have failed of.
#[derive(Default)]
struct Suspicion {
    /// Nobody told of the disk: it may be that a part of it cannot be read, also one that nobody asks for.
    is_there: bool,
    /// How many bytes must be free for it to be made anew; 0 if it need not be, or has not been tried.
    room: u64,
}

enum Opened {
    Open(Arc<Engine>),
    /// Not open, and why; with what the marks tell of what it holds.
    Not(LogError, BTreeMap<Number, Mark>),
}

impl FjallLog {
    /// Opens the log in `directory`, which is made if there is none.
    ///
    /// A store that cannot be read is no error, or a server would be started again and again to no end: the log tells
    /// with every call, and of each index in [`Log::gone`].
    pub fn open(directory: &Path, durability: Durability) -> Result<Self, OpenError> {
        let directory = Arc::new(Directory::take(directory)?);
        let failed = |path: &Path, source| OpenError::Io {
            path: path.into(),
            source,
        };
        making::finish(&directory)
            .and_then(|()| making::make_first(&directory))
            .map_err(|source| failed(directory.path(), source))?;
        let path = directory.join(MARKS);
        let (_, marked) = Marks::open(&path).map_err(|source| failed(&path, source))?;
        let log = Self {
            opened: RwLock::new(Opened::Not(LogError::Closed, BTreeMap::new())),
            reopening: Mutex::default(),
            durability,
            directory,
        };
        let directory = log.directory.path().display();
        let opened = match log.open_whole(&mut log.reopening.lock()) {
            Ok(engine) => {
                info!(%directory, "opened the log");
                Opened::Open(Arc::new(engine))
            }
            Err(why) => {
                error!(%directory, error = %why, "every call will say so");
                Opened::Not(why, marked)
            }
        };
        *log.opened.write() = opened;
        Ok(log)
    }

    fn engine(&self) -> Result<Arc<Engine>, LogError> {
        match &*self.opened.read() {
            Opened::Open(engine) => Ok(Arc::clone(engine)),
            Opened::Not(why, _) => Err(why.clone()),
        }
    }

    fn open_as_it_is(&self) -> Result<Engine, LogError> {
        let (marks, marked) = Marks::open(&self.directory.join(MARKS)).map_err(shut)?;
        Engine::open(&self.directory, self.durability, (marks, &marked))
    }

    /// Whether the disk would let the store be opened anew; `failed` is the store, if it is open still.
    fn probe(&self, failed: Option<&Engine>, suspicion: &mut Suspicion) -> Result<(), LogError> {
        let told = |error: io::Error| match failed {
            Some(_) => LogError::Storage {
                what: error.to_string(),
            },
            None => shut(error),
        };
        // It begins by moving these, and fails at once if it cannot.
        let unmoved = failed.map_or(0, Engine::unmoved);
        self.directory.probe(STORE, unmoved).map_err(told)?;
        self.directory.has_room(suspicion.room).map_err(told)?;
        if let (true, Some(failed)) = (suspicion.is_there, failed) {
            // A disk that cannot be read would make it fail again.
            suspicion.room = making::missing_room(&self.directory, &failed.store)?;
            self.directory.has_room(suspicion.room).map_err(told)?;
        }
        Ok(())
    }

    /// Opens the store, after making it anew if a part of it cannot be read.
    fn open_whole(&self, suspicion: &mut Suspicion) -> Result<Engine, LogError> {
        making::finish(&self.directory).map_err(shut)?;
        let opened = self.open_as_it_is();
        let unreadable = match &opened {
            Ok(engine) => {
                if !engine.unreadable && !suspicion.is_there {
                    return opened;
                }
                engine.shut();
                engine.unreadable
            }
            // The entries of indices may be what cannot be read.
            Err(LogError::Unopened { .. }) => false,
            Err(why) if is_untold(why) => false,
            Err(_) => return opened,
        };
        drop(opened);
        let remade = making::remake(&self.directory, unreadable);
        // With one that was made anew beside it, this one is not to be written to any more.
        making::finish(&self.directory).map_err(shut)?;
        suspicion.room = match remade {
            Ok(Remade::NoRoom(needed)) => needed,
            Ok(Remade::Whole | Remade::Anew) => 0,
            Err(why) => {
                error!(error = %why, "the store cannot be made anew");
                0
            }
        };
        // fjall may have come upon the damage already.
        self.open_as_it_is().map_err(|why| match is_untold(&why) {
            true => self
                .directory
                .has_room(suspicion.room)
                .err()
                .map_or(why, shut),
            false => why,
        })
    }
}

impl Drop for FjallLog {
    fn drop(&mut self) {
        if let Ok(engine) = self.engine() {
            engine.shut();
        }
    }
}

impl Log for FjallLog {
    fn indexes(&self) -> Result<Vec<Entry>, LogError> {
        match self.engine() {
            Ok(engine) => Ok(engine.entries()),
            // None of which more is known than that it is gone.
            Err(LogError::Unopened { .. } | LogError::Shut { .. }) => Ok(Vec::new()),
            Err(error) => Err(error),
        }
    }

    fn gone(&self) -> Vec<Gone> {
        match &*self.opened.read() {
            Opened::Open(engine) => engine.gone(),
            Opened::Not(why, marked) => {
                let named = marked.values().filter(|mark| !mark.deleted);
                let gone = named.map(|mark| Gone {
                    name: mark.name.to_string(),
                    uid: mark.uid,
                    why: why_gone(why, mark),
                });
                gone.collect()
            }
        }
    }

    fn create(&self, entry: Entry) -> Result<(), LogError> {
        self.engine()?.create(entry)
    }

    fn restore(&self, entry: Entry, origin: Origin) -> Result<Box<dyn Restoring>, LogError> {
        Ok(Box::new(self.engine()?.restore(entry, origin)?))
    }

    fn delete(&self, uid: Uid) -> Result<(), LogError> {
        self.engine()?.delete(uid)
    }

    fn append(&self, uid: Uid, expected: u64, effects: Effects) -> Result<Arc<Record>, LogError> {
        self.engine()?.append(uid, expected, effects)
    }

    fn synced(&self, uid: Uid, revision: u64) -> BoxFuture<'static, Result<u64, LogError>> {
        let synced = self
            .engine()
            .and_then(|engine| engine.synced(uid, revision));
        synced.unwrap_or_else(|error| std::future::ready(Err(error)).boxed())
    }

    fn tail(
        &self,
        uid: Uid,
        after: Option<u64>,
        most: usize,
    ) -> Result<Vec<Arc<Record>>, LogError> {
        let engine = self.engine()?;
        engine.index(uid)?.tail(&engine.store, after, most)
    }

    fn points(&self, uid: Uid) -> Result<Arc<dyn View>, LogError> {
        let engine = self.engine()?;
        engine.index(uid)?.pin(&engine.store)
    }

    fn operations(&self, uid: Uid) -> Result<Vec<Arc<Operation>>, LogError> {
        let engine = self.engine()?;
        engine.index(uid)?.operations(&engine.store)
    }

    fn trim(&self, uid: Uid, keep: &Keep) -> Result<(), LogError> {
        self.engine()?.index(uid)?.trim(keep)
    }

    fn is_busy(&self) -> bool {
        self.engine().is_ok_and(|engine| engine.is_busy())
    }

    fn failure(&self) -> Option<LogError> {
        match self.engine() {
            Ok(engine) => engine.failure(),
            Err(error) => Some(error),
        }
    }

    fn reopen(&self) -> Result<(), LogError> {
        let mut suspicion = self.reopening.lock();
        let Some(failure) = self.failure() else {
            return Ok(());
        };
        suspicion.is_there |= is_untold(&failure);
        // While it cannot be written the failed store is better than none: it can be read.
        let failed = self.engine().ok();
        if let Err(why) = self.probe(failed.as_deref(), &mut suspicion) {
            if let Some(failed) = failed {
                failed.explain(&why);
            }
            return Err(why);
        }
        if let Some(failed) = failed {
            *self.opened.write() = Opened::Not(LogError::Closed, BTreeMap::new());
            failed.shut();
        }
        let (opened, outcome) = match self.open_whole(&mut suspicion) {
            Ok(engine) => {
                *suspicion = Suspicion::default();
                info!("opened the log anew");
                (Opened::Open(Arc::new(engine)), Ok(()))
            }
            Err(why) => {
                let marked = Marks::open(&self.directory.join(MARKS));
                let marked = marked.map(|(_, marked)| marked).unwrap_or_default();
                (Opened::Not(why.clone(), marked), Err(why))
            }
        };
        *self.opened.write() = opened;
        outcome
    }
}

/// Of a store that cannot be opened: what that means for an index.
fn why_gone(why: &LogError, mark: &Mark) -> LogError {
    match why {
        LogError::Unopened { what, .. } => LogError::Unopened {
            what: what.clone(),
            revision: mark.revision,
        },
        why => why.clone(),
    }
}
