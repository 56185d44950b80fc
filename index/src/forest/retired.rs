//! References to values that snapshots share, held by the owner so that no reader has to free one.

use std::sync::Arc;

/// The number of references checked at every change. It is more than a change adds, so all are checked before their
/// number has doubled.
const CHECKS_PER_CHANGE: usize = 2;

/// References of the forest to values that it replaced while snapshots shared them.
///
/// The thread that drops the last reference frees the value, and an allocator may make a thread wait that frees the
/// memory of another one: with glibc's, readers next to a writer are slower. With these references the last one is the
/// forest's, so the writer frees. Between two changes, about one unused reference is kept for each that readers held at
/// the first; a pause drops all of them.
#[derive(Debug)]
pub(super) struct Retired<T> {
    held: Vec<Arc<T>>,
    /// The next reference to check.
    next: usize,
}

impl<T> Default for Retired<T> {
    fn default() -> Self {
        let held = Vec::new();
        Self { held, next: 0 }
    }
}

impl<T: Clone> Retired<T> {
    /// Acts like [`Arc::make_mut`], but keeps a reference to a value that others still share.
    pub(super) fn make_mut<'a>(&mut self, shared: &'a mut Arc<T>) -> &'a mut T {
        self.free_some();
        if Arc::get_mut(shared).is_none() {
            self.held.push(Arc::clone(shared));
        }
        Arc::make_mut(shared)
    }

    /// Frees values that nothing else refers to, among the next references.
    fn free_some(&mut self) {
        for _ in 0..CHECKS_PER_CHANGE.min(self.held.len()) {
            self.next = self.next.checked_sub(1).unwrap_or(self.held.len() - 1);
            // Without another reference none can be made: new snapshots are of the head.
            if Arc::strong_count(&self.held[self.next]) == 1 {
                // The last one takes its place; it was checked before, or added since.
                self.held.swap_remove(self.next);
            }
        }
    }

    /// Drops all references: a reader without a concurrent writer never waits.
    pub(super) fn clear(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A writer's changes, each under the snapshot that the change before published.
    fn write(retired: &mut Retired<u32>, head: &mut Arc<u32>, steps: usize) {
        for _ in 0..steps {
            let published = Arc::clone(head);
            *retired.make_mut(head) += 1;
            drop(published);
        }
    }

    /// The snapshots of some readers, one of each change.
    fn read(retired: &mut Retired<u32>, head: &mut Arc<u32>, readers: usize) -> Vec<Arc<u32>> {
        let step = |_| {
            let snapshot = Arc::clone(head);
            write(retired, head, 1);
            snapshot
        };
        (0..readers).map(step).collect()
    }

    #[test]
    fn readers_never_have_the_last_reference() {
        let (mut retired, mut head) = (Retired::default(), Arc::new(0));
        for (step, snapshot) in (0..).zip(&read(&mut retired, &mut head, 100)) {
            assert_eq!((**snapshot, Arc::strong_count(snapshot)), (step, 2));
        }
    }

    #[test]
    fn values_without_readers_are_freed_next_to_ones_read_for_long() {
        let (mut retired, mut head) = (Retired::default(), Arc::new(0));
        for readers in [0, 1, 10, 100] {
            let long = read(&mut retired, &mut head, readers);
            write(&mut retired, &mut head, 10_000);
            assert!(
                retired.held.len() <= 2 * readers + 3,
                "{}",
                retired.held.len()
            );
            assert!(long.iter().all(|snapshot| Arc::strong_count(snapshot) == 2));
            drop(long);
            write(&mut retired, &mut head, 2 * readers + 3);
            assert!(retired.held.len() <= 3, "{}", retired.held.len());
        }
    }

    #[test]
    fn a_value_that_is_not_shared_changes_in_place_and_frees_earlier_ones() {
        let (mut retired, mut head) = (Retired::default(), Arc::new(0));
        let long = read(&mut retired, &mut head, 10);
        assert!(retired.held.len() >= long.len());
        drop(long);
        let place = Arc::as_ptr(&head);
        for _ in 0..10 {
            *retired.make_mut(&mut head) += 1;
        }
        assert_eq!((*head, retired.held.len()), (20, 0));
        assert_eq!(Arc::as_ptr(&head), place);
    }

    #[test]
    fn a_pause_leaves_values_to_their_readers() {
        let (mut retired, mut head) = (Retired::default(), Arc::new(0));
        let snapshot = Arc::clone(&head);
        write(&mut retired, &mut head, 1);
        retired.clear();
        assert_eq!(Arc::strong_count(&snapshot), 1);
    }
}
