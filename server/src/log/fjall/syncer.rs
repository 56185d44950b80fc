//! Group commit: one thread syncs the journal for all writers.
//!
//! A writer commits its batch, which only hands it to the journal, and announces it ([`Syncer::written`]). The thread
//! syncs once for all batches announced meanwhile, writes the sync marks, and only then wakes the waiting writers. If
//! many writers shared the last sync, the thread first waits briefly for their next batches. If acknowledgements do not
//! depend on this store, it syncs at an interval.

use std::{
    sync::{Arc, LazyLock},
    thread::JoinHandle,
    time::{Duration, Instant},
};

use parking_lot::{Condvar, Mutex};
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};

use super::{
    failure::Failure,
    index::Index,
    journal::StoreJournal,
    sync_marks::{Mark, Marks},
};
use crate::log::LogError;

/// From this many batches in one sync on, the thread assumes several writers, and waits for their next batches.
const MIN_SHARED_BATCHES: usize = 8;

/// The maximum wait for those next batches: about the duration of a sync. Each saved sync leaves processor time to the
/// writers.
const MAX_WAIT: Duration = Duration::from_micros(200);

/// The times of the syncs of this process, in seconds from 0.1 ms to 3 s. A process has one store at a time.
pub(crate) static SYNCS: LazyLock<Histogram> =
    LazyLock::new(|| Histogram::new(exponential_buckets(1e-4, 2.0, 16)));

/// The thread that syncs, and its shared state.
pub(super) struct Syncer {
    shared: Arc<Shared>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

struct Shared {
    state: Mutex<SyncState>,
    /// Notified when a batch was announced, a thread waits for a sync, or the thread is to end.
    wake: Condvar,
    /// Notified when batches were synced, or the syncer has failed.
    done: Condvar,
    failure: Arc<Failure>,
    /// The time between two syncs if no thread waits for one.
    interval: Duration,
}

#[derive(Default)]
struct SyncState {
    batches: u64,
    /// The number of announcements that the thread waits for.
    enough: usize,
    /// The new marks of the announced batches, until they are written.
    marks: Vec<(Arc<Index>, Mark)>,
    /// The number of threads in [`Syncer::wait`].
    waiting: usize,
    stop: bool,
    /// The number of batches that are synced.
    synced: u64,
    /// The failure or the end after which nothing is synced.
    failed: Option<LogError>,
}

impl Syncer {
    /// Starts the thread. It syncs once an `interval` if no thread waits, and at once if that is zero.
    pub(super) fn start(
        mut journal: StoreJournal,
        mut marks: Marks,
        failure: Arc<Failure>,
        interval: Duration,
    ) -> std::io::Result<Self> {
        let shared = Arc::new(Shared {
            state: Mutex::default(),
            wake: Condvar::new(),
            done: Condvar::new(),
            failure,
            interval,
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

    /// Announces a committed batch that moved an index to `mark`.
    pub(super) fn written(&self, index: &Arc<Index>, mark: Mark) {
        let mut state = self.shared.state.lock();
        state.batches += 1;
        state.marks.push((Arc::clone(index), mark));
        let enough = state.marks.len() >= state.enough;
        drop(state);
        if enough {
            self.shared.wake.notify_one();
        }
    }

    /// Ends the thread, once all announced batches are synced.
    pub(super) fn stop(&self) {
        self.shared.state.lock().stop = true;
        self.shared.wake.notify_one();
        if let Some(thread) = self.thread.lock().take() {
            // The thread panics only by a bug, and the panic hook has printed it.
            let _ = thread.join();
        }
    }

    /// Returns once all batches announced before are synced.
    pub(super) fn wait(&self) -> Result<(), LogError> {
        let mut state = self.shared.state.lock();
        let batches = state.batches;
        state.waiting += 1;
        self.shared.wake.notify_one();
        let outcome = loop {
            match &state.failed {
                _ if state.synced >= batches => break Ok(()),
                Some(why) => break Err(why.clone()),
                None => self.shared.done.wait(&mut state),
            }
        };
        state.waiting -= 1;
        outcome
    }
}

impl Drop for Syncer {
    fn drop(&mut self) {
        self.stop();
    }
}

impl Shared {
    fn run(&self, journal: &mut StoreJournal, marks: &mut Marks) {
        let mut last = 0;
        loop {
            let mut state = self.state.lock();
            state.enough = 1;
            while state.marks.is_empty() && !state.stop {
                self.wake.wait(&mut state);
            }
            if !self.interval.is_zero() {
                state.enough = usize::MAX;
                let until = Instant::now() + self.interval;
                while state.waiting == 0
                    && !state.stop
                    && !self.wake.wait_until(&mut state, until).timed_out()
                {}
            }
            state.enough = last / 4 * 3;
            if last >= MIN_SHARED_BATCHES && state.marks.len() < state.enough && !state.stop {
                self.wake.wait_for(&mut state, MAX_WAIT);
            }
            let batches = state.batches;
            let reached = std::mem::take(&mut state.marks);
            if reached.is_empty() {
                // Nothing syncs a batch that is announced from now on.
                state.failed = Some(LogError::Closed);
                return;
            }
            drop(state);
            last = reached.len();
            let began = Instant::now();
            let synced = journal.sync();
            SYNCS.observe(began.elapsed().as_secs_f64());
            let synced = synced.and_then(|()| {
                let reached = reached.iter().map(|(index, mark)| (index.number, mark));
                let written = marks.write(reached);
                written.map_err(|error| LogError::Storage {
                    what: error.to_string(),
                })
            });
            let failed = match synced {
                Ok(()) => None,
                // Noted before the writers are woken, so that none of them continues to write.
                Err(error) => Some(self.failure.note(error)),
            };
            if failed.is_none() {
                for (index, mark) in &reached {
                    index.set_durable(mark.revision);
                }
            }
            let mut state = self.state.lock();
            if failed.is_none() {
                state.synced = batches;
            }
            state.failed.clone_from(&failed);
            self.done.notify_all();
            if failed.is_some() {
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        log::{
            Origin,
            fjall::{Durability, index::State, layout::Sum, store::Store},
        },
        testing::arm,
    };

    /// A call may write to a store that is about to close.
    #[test]
    fn a_batch_that_is_announced_after_the_end_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("store");
        let store = Arc::new(Store::open(&path, Durability::Fsync).unwrap());
        let (marks, _) = Marks::open(&directory.path().join("marks")).unwrap();
        let journal = StoreJournal::new(store, path);
        let syncer = Syncer::start(journal, marks, Arc::default(), Duration::ZERO).unwrap();
        syncer.stop();
        assert_eq!(syncer.wait(), Ok(()));
        let state = State::new(Origin::START, Sum::default());
        let index = Index::new(0, arm(), state);
        syncer.written(&index, index.head_mark());
        assert_eq!(syncer.wait(), Err(LogError::Closed));
    }
}
