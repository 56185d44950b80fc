//! An index that closes, and resumes once its log was reopened.

use std::sync::{Arc, atomic::Ordering::Relaxed};

use tracing::error;

use super::{ApplyLoop, Hosted, Published};
use crate::{
    log::{LogError, Record, View},
    registry::{RegistryError, in_flight::notify, operations::Operations, stopped::is_damage},
};

/// The bytes of records that are read at once.
const READ_BYTES: usize = 1 << 20;

impl Hosted {
    /// Resumes after the log was reopened, from its points `view`. Returns false if these are not the published points
    /// with all later records applied, if another server contradicts the index, or if its apply loop has panicked. Blocks.
    pub(in crate::registry) fn resume(self: &Arc<Self>, view: &Arc<dyn View>) -> bool {
        let mut writer = Arc::clone(&self.writer).blocking_lock_owned();
        let applied = Arc::clone(&self.applied).blocking_lock_owned();
        if self.has_panicked.load(Relaxed) || self.is_retired.load(Relaxed) {
            return false;
        }
        let published = self.published();
        let position = published.view.position();
        let stored = view.position();
        let is_resumed = if stored.revision == position.revision {
            self.publish(&Arc::new(Published {
                snapshot: published.snapshot.clone(),
                revision: position.revision,
                view: Arc::clone(view),
                is_shared: published.is_shared,
            }));
            stored == position
        } else if let Some(later) = stored.revision.checked_sub(position.revision) {
            let records = self.read_after(position.revision, later as usize);
            let last = records.last().map(|last| last.position());
            let applied = || self.apply_now(applied, &records, |_| Ok(Arc::clone(view)));
            last == Some(stored) && applied().is_ok()
        } else {
            false
        };
        if !is_resumed {
            return false;
        }
        // An operation that changed nothing may have seen records that the journal has lost.
        let operations = match self.host.log.points.operations(self.uid) {
            Ok(operations) => operations,
            Err(error) => {
                error!(index = self.name(), %error, "cannot read the remembered operations");
                let why = RegistryError::from(error).of_copy(self.is_shared());
                // A copy of another server mends this; another attempt does not, and a contradiction is the operator's.
                let _apply_loop = self.apply_loop.lock();
                if is_damage(&why) && !self.is_contradicted() {
                    self.close(why);
                }
                return false;
            }
        };
        *self.operations.lock() = Operations::of(self.host.options.operations, operations);
        // The index may not have closed: no receipt will decide the records in flight.
        let why = self
            .closed()
            .unwrap_or(RegistryError::Log(LogError::Closed));
        let (failed, refusals) = {
            let mut in_flight = self.in_flight.lock();
            (in_flight.fail(&why), in_flight.refusals())
        };
        notify(failed);
        writer.catch_up(self.published(), self.last_change.load(Relaxed), refusals);
        let hosted = Arc::downgrade(self);
        let mut apply_loop = self.apply_loop.lock();
        if self.has_panicked.load(Relaxed) || self.is_contradicted() {
            return false;
        }
        // NATS may have lost records that another server still has.
        self.peer_comparison.resumptions.fetch_add(1, Relaxed);
        let next = apply_loop.number + 1;
        *apply_loop = ApplyLoop::start(next, hosted, &self.host, self.uid, stored);
        self.state.send_modify(|state| state.closed = None);
        true
    }

    /// The next `count` records of the journal after a revision, or fewer. A shared journal may have far more.
    fn read_after(&self, revision: u64, count: usize) -> Vec<Arc<Record>> {
        let journal = &self.host.log.journal;
        let mut records: Vec<Arc<Record>> = Vec::new();
        while records.len() < count {
            let after = records.last().map_or(revision, |last| last.revision());
            match journal.read(self.uid, Some(after), READ_BYTES) {
                Ok(read) if !read.is_empty() => records.extend(read),
                _ => break,
            }
        }
        records.truncate(count);
        records
    }

    /// Closes the index, because its apply loop of this number has ended.
    pub(in crate::registry) fn end_loop(&self, number: u64, why: RegistryError) {
        let apply_loop = self.apply_loop.lock();
        if why == RegistryError::Stopped {
            // The panic may have left the forest half changed: the index does not resume.
            self.has_panicked.store(true, Relaxed);
        }
        if apply_loop.number == number {
            self.close(why);
        }
    }

    /// Replaces the error of a closed index; false if the index is open.
    pub(in crate::registry) fn close_again(&self, why: RegistryError) -> bool {
        // The index cannot resume meanwhile.
        let _apply_loop = self.apply_loop.lock();
        let is_closed = self.is_closed();
        if is_closed {
            self.close(why);
        }
        is_closed
    }

    /// Closes the index: later writes, and calls that wait for it, get `why`.
    pub(in crate::registry) fn close(&self, why: RegistryError) {
        let why = why.of_copy(self.is_shared());
        let decided = {
            // No writer may see the new count of refusals and an open index: nothing would decide its record.
            let mut in_flight = self.in_flight.lock();
            let decided = in_flight.fail(&why);
            self.state.send_modify(|state| state.closed = Some(why));
            decided
        };
        notify(decided);
    }

    /// The error that closed it; None if it takes records.
    pub(in crate::registry) fn closed(&self) -> Option<RegistryError> {
        self.state.borrow().closed.clone()
    }

    /// True if it takes no record now.
    pub(crate) fn is_closed(&self) -> bool {
        self.state.borrow().closed.is_some()
    }
}

#[cfg(test)]
mod tests {
    use std::{sync::atomic::AtomicUsize, thread};

    use super::*;
    use crate::{
        log::{Journal, MemoryLog, Receipt, RecordStream, Uid},
        registry::{Registry, RegistryOptions},
        testing::{arm, log_with, recorded, registry, submit},
    };

    /// Counts the records that are read.
    struct Counted {
        local: Arc<MemoryLog>,
        read: AtomicUsize,
    }

    impl Journal for Counted {
        fn submit(&self, uid: Uid, record: Arc<Record>) -> Result<Receipt, LogError> {
            self.local.submit(uid, record)
        }

        fn read(
            &self,
            uid: Uid,
            after: Option<u64>,
            max_bytes: usize,
        ) -> Result<Vec<Arc<Record>>, LogError> {
            let read = self.local.read(uid, after, max_bytes)?;
            self.read.fetch_add(read.len(), Relaxed);
            Ok(read)
        }

        fn follow(&self, uid: Uid, after: u64) -> RecordStream {
            self.local.follow(uid, after)
        }

        fn newest(&self, uid: Uid) -> Result<u64, LogError> {
            self.local.newest(uid)
        }
    }

    /// A journal of NATS may have hours of records that a store which comes back lacks.
    #[tokio::test]
    async fn few_records_beyond_those_of_the_store_are_read() {
        let entry = arm();
        let local = log_with(&entry, &[]);
        (0..100).for_each(|_| submit(&local, entry.uid));
        let journal = Arc::new(Counted {
            local: Arc::clone(&local),
            read: AtomicUsize::new(0),
        });
        let registry = registry(&journal, &local, RegistryOptions::default());
        let hosted = registry.get("arm").unwrap();
        for (after, count) in [(0, 3), (50, 45), (95, 5)] {
            journal.read.store(0, Relaxed);
            let revisions = hosted.read_after(after, count);
            let revisions = revisions.iter().map(|record| record.revision());
            let count = count as u64;
            assert!(revisions.eq(after + 1..=after + count));
            assert!(journal.read.load(Relaxed) as u64 <= count + READ_BYTES as u64 / 30_000);
        }
        assert_eq!(hosted.read_after(95, 9).len(), 5);
    }

    /// A writer with the new count and an open index would add a record that nothing decides.
    #[tokio::test]
    async fn no_writer_sees_the_new_count_of_refusals_before_the_index_is_closed() {
        let registry = Registry::new(recorded(1), RegistryOptions::default());
        registry.replay().unwrap();
        let hosted = registry.get("arm").unwrap();
        let before = hosted.in_flight.lock().refusals();
        // The index cannot close while its state is read.
        let open = hosted.state.borrow();
        let closing = {
            let hosted = Arc::clone(&hosted);
            thread::spawn(move || hosted.close(RegistryError::Deleted))
        };
        while let Some(in_flight) = hosted.in_flight.try_lock() {
            assert_eq!(in_flight.refusals(), before);
            drop(in_flight);
            thread::yield_now();
        }
        drop(open);
        closing.join().unwrap();
        assert!(hosted.is_closed());
        assert_eq!(hosted.in_flight.lock().refusals(), before + 1);
    }
}
