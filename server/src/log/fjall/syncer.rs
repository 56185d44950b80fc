//! Group commit: one thread syncs the journal for all writers.
//!
//! A writer commits its batch, which only hands it to the journal, and announces it ([`Syncer::written`]). The thread
//! syncs once for all that was announced meanwhile, then notes in the marks how far each index has come, and only then
//! tells those who wait. Where the last sync was shared by many, it waits a moment for them to be back.

use std::{sync::Arc, thread::JoinHandle, time::Duration};

use futures_util::{FutureExt, future::BoxFuture};
use parking_lot::{Condvar, Mutex};
use tokio::sync::watch;

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
    synced: watch::Sender<Synced>,
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
}

#[derive(Clone, Default)]
struct Synced {
    batches: u64,
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
            synced: watch::Sender::default(),
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
            let synced = self.shared.synced.borrow().clone();
            match synced.failed {
                _ if synced.batches >= batches => return Ok(()),
                Some(why) => return Err(why),
                None => self.shared.done.wait(&mut announced),
            }
        }
    }

    /// Resolves once `revision` of the index is synced, to how far it is synced then.
    pub(super) fn synced(
        &self,
        index: Arc<Index>,
        revision: u64,
    ) -> BoxFuture<'static, Result<u64, LogError>> {
        let mut synced = self.shared.synced.subscribe();
        async move {
            let reached = synced
                .wait_for(|synced| index.durable() >= revision || synced.failed.is_some())
                .await;
            match (index.durable(), reached) {
                (durable, _) if durable >= revision => Ok(durable),
                (_, Ok(synced)) => Err(synced.failed.clone().unwrap_or_else(ended)),
                (_, Err(_)) => Err(ended()),
            }
        }
        .boxed()
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
            match synced {
                Ok(()) => {
                    for (index, mark) in &reached {
                        index.set_durable(mark.revision);
                    }
                    self.synced.send_modify(|synced| synced.batches = batches);
                    self.tell_blocked();
                }
                Err(what) => {
                    // Before anybody is told, who might write on.
                    let failed = self.failure.note(LogError::Storage { what });
                    self.synced
                        .send_modify(|synced| synced.failed = Some(failed));
                    self.tell_blocked();
                    return;
                }
            }
        }
    }

    /// Under the lock under which they looked, or one that is about to wait would miss it.
    fn tell_blocked(&self) {
        let _looked = self.announced.lock();
        self.done.notify_all();
    }
}

/// The thread has ended, with the log or by a bug.
fn ended() -> LogError {
    LogError::Storage {
        what: "it was closed".into(),
    }
}
