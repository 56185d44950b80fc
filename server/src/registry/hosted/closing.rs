//! An index that closes, and resumes once its log was reopened.

use std::sync::{Arc, atomic::Ordering::Relaxed};

use super::{ApplyLoop, Hosted, Published};
use crate::{
    log::View,
    registry::{RegistryError, in_flight::notify},
};

impl Hosted {
    /// Resumes after the log was reopened, from its points `view`. Returns false if these are not the published points
    /// with all later records applied, or if another server contradicts the index. Blocks.
    pub(in crate::registry) fn resume(self: &Arc<Self>, view: &Arc<dyn View>) -> bool {
        let mut writer = Arc::clone(&self.writer).blocking_lock_owned();
        let applied = Arc::clone(&self.applied).blocking_lock_owned();
        if self.is_retired.load(Relaxed) {
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
            }));
            stored == position
        } else if let Some(later) = stored.revision.checked_sub(position.revision) {
            let journal = &self.host.log.journal;
            let records = journal.read(self.uid, Some(position.revision), usize::MAX);
            records.is_ok_and(|mut records| {
                // A journal elsewhere may have more than the store.
                records.truncate(later as usize);
                let last = records.last().map(|last| last.position());
                let applied = || self.apply_now(applied, &records, |_| Ok(Arc::clone(view)));
                last == Some(stored) && applied().is_ok()
            })
        } else {
            false
        };
        if is_resumed {
            // The index may not have closed: no receipt will decide the records in flight.
            let why = self.closed().unwrap_or(RegistryError::Stopped);
            let (failed, refusals) = {
                let mut in_flight = self.in_flight.lock();
                (in_flight.fail(&why), in_flight.refusals())
            };
            notify(failed);
            writer.catch_up(self.published(), self.last_change.load(Relaxed), refusals);
            let hosted = Arc::downgrade(self);
            let mut apply_loop = self.apply_loop.lock();
            if self.is_contradicted() {
                return false;
            }
            // NATS may have lost records that another server still has.
            self.first_write.compared.store(0, Relaxed);
            let next = apply_loop.number + 1;
            *apply_loop = ApplyLoop::start(next, hosted, &self.host, (self.uid, stored));
            self.state.send_modify(|state| state.closed = None);
        }
        is_resumed
    }

    /// Closes the index, because its apply loop of this number has ended.
    pub(in crate::registry) fn end_loop(&self, number: u64, why: RegistryError) {
        let apply_loop = self.apply_loop.lock();
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
    pub(in crate::registry) fn is_closed(&self) -> bool {
        self.state.borrow().closed.is_some()
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use super::*;
    use crate::{
        registry::{Registry, RegistryOptions},
        testing::recorded,
    };

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
