//! Group commit: one thread syncs the journal for all writers.
//!
//! A writer commits its batch, which only hands it to the journal, and announces it ([`Syncer::written`]). The thread
//! syncs once for all that was announced meanwhile, then notes in the marks how far each index has come, and only then
//! tells those who wait. Where the last sync was shared by many, it waits a moment for them to be back.

use std::{sync::Arc, thread::JoinHandle, time::Duration};

use parking_lot::{Condvar, Mutex};

use super::{
    failure::Failure,
    index::Index,
    journal::Journal,
    sync_marks::{Mark, Marks},
};
use crate::log::LogError;

/// So many batches in one sync come from several writers, who will be back.
const MANY: usize = 8;

/// How long to wait then for most of them to be back, before the next sync: about as long as a sync takes. Each takes a
/// good part of a core from those who write.
const LINGER: Duration = Duration::from_micros(200);

/// See the module.
pub(super) struct Syncer {
    shared: Arc<Shared>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

struct Shared {
    announced: Mutex<Announced>,
    /// Something was announced, or the thread is to end.
    wake: Condvar,
    /// Something was synced, or nothing will be any more.
    done: Condvar,
    failure: Arc<Failure>,
}

#[derive(Default)]
struct Announced {
    batches: u64,
    /// How many announcements the thread is waiting for.
    enough: usize,
    /// Where which indices are by these batches, unless a mark says so already.
    marks: Vec<(Arc<Index>, Mark)>,
    stop: bool,
    /// The number of batches that are synced.
    synced: u64,
    /// The failure after which nothing is synced.
    failed: Option<LogError>,
}

impl Syncer {
    /// Starts the thread.
    pub(super) fn start(
        mut journal: Journal,
        mut marks: Marks,
        failure: Arc<Failure>,
    ) -> std::io::Result<Self> {
        let shared = Arc::new(Shared {
            announced: Mutex::default(),
            wake: Condvar::new(),
            done: Condvar::new(),
            failure,
        });
        let work = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name("wayfold-sync".into())
            .spawn(move || work.run(&mut journal, &mut marks))?;
        Ok(Self {
            shared,
            thread: Mutex::new(Some(thread)),
        })
    }

    /// Announces a committed batch, which brought an index to `mark`.
    pub(super) fn written(&self, index: &Arc<Index>, mark: Mark) {
        let mut announced = self.shared.announced.lock();
        announced.batches += 1;
        announced.marks.push((Arc::clone(index), mark));
        let enough = announced.marks.len() >= announced.enough;
        drop(announced);
        if enough {
            self.shared.wake.notify_one();
        }
    }

    /// Ends the thread, once all that was announced is synced.
    pub(super) fn stop(&self) {
        self.shared.announced.lock().stop = true;
        self.shared.wake.notify_one();
        if let Some(thread) = self.thread.lock().take() {
            // It panics only by a bug, of which the panic itself has told.
            let _ = thread.join();
        }
    }

    /// Returns once all that was announced before is synced.
    pub(super) fn wait(&self) -> Result<(), LogError> {
        let mut announced = self.shared.announced.lock();
        let batches = announced.batches;
        loop {
            match &announced.failed {
                _ if announced.synced >= batches => return Ok(()),
                Some(why) => return Err(why.clone()),
                None => self.shared.done.wait(&mut announced),
            }
        }
    }
}

impl Drop for Syncer {
    fn drop(&mut self) {
        self.stop();
    }
}

impl Shared {
    fn run(&self, journal: &mut Journal, marks: &mut Marks) {
        let mut last = 0;
        loop {
            let mut announced = self.announced.lock();
            announced.enough = 1;
            while announced.marks.is_empty() && !announced.stop {
                self.wake.wait(&mut announced);
            }
            announced.enough = last / 4 * 3;
            if last >= MANY && announced.marks.len() < announced.enough && !announced.stop {
                self.wake.wait_for(&mut announced, LINGER);
            }
            let batches = announced.batches;
            let reached = std::mem::take(&mut announced.marks);
            drop(announced);
            if reached.is_empty() {
                return;
            }
            last = reached.len();
            let synced = journal.sync().and_then(|()| {
                let reached = reached.iter().map(|(index, mark)| (index.number, mark));
                marks.write(reached).map_err(|error| error.to_string())
            });
            let failed = match synced {
                Ok(()) => None,
                // Noted before the writers hear of it, so that none of them writes on.
                Err(what) => Some(self.failure.note(LogError::Storage { what })),
            };
            if failed.is_none() {
                for (index, mark) in &reached {
                    index.set_durable(mark.revision);
                }
            }
            let mut announced = self.announced.lock();
            if failed.is_none() {
                announced.synced = batches;
            }
            announced.failed.clone_from(&failed);
            self.done.notify_all();
            if failed.is_some() {
                return;
            }
        }
    }
}
