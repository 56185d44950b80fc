//! What readers share of the level that grows, so that none of them has to free it.

use std::sync::Arc;

/// At every change so many holds are looked at: more than are added, so that all have been before there are twice as many.
const LOOKS: usize = 2;

/// The forest's own holds of what it has replaced while snapshots shared it.
///
/// Whoever drops the last hold of something frees it, and an allocator may let who frees what another thread has allocated
/// wait for that thread: with glibc's, readers beside a writer had half of their rate by that. With these, the last
/// hold is the forest's, and whoever writes frees, what a reader has held for long too. At the last change it held in vain
/// about as many as readers held; a pause lets go of all.
#[derive(Debug)]
pub(super) struct Past<T> {
    held: Vec<Arc<T>>,
    /// The next hold to look at.
    next: usize,
}

impl<T> Default for Past<T> {
    fn default() -> Self {
        let held = Vec::new();
        Self { held, next: 0 }
    }
}

impl<T: Clone> Past<T> {
    /// As [`Arc::make_mut`], but keeps a hold of what others go on to share.
    pub(super) fn make_mut<'a>(&mut self, shared: &'a mut Arc<T>) -> &'a mut T {
        self.look();
        if Arc::get_mut(shared).is_none() {
            self.held.push(Arc::clone(shared));
        }
        Arc::make_mut(shared)
    }

    /// Lets go of what only this still holds, among the next holds.
    fn look(&mut self) {
        for _ in 0..LOOKS.min(self.held.len()) {
            self.next = self.next.checked_sub(1).unwrap_or(self.held.len() - 1);
            if is_last_hold(&self.held[self.next]) {
                // What takes its place is the last, which has been looked at, or was added since.
                self.held.swap_remove(self.next);
            }
        }
    }

    /// Lets go of everything: whom nobody writes beside, nobody lets wait.
    pub(super) fn clear(&mut self) {
        *self = Self::default();
    }
}

/// Then no one can come by another hold of it: new snapshots are of the head.
fn is_last_hold<T>(held: &Arc<T>) -> bool {
    Arc::strong_count(held) == 1
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A writer's steps, each under the snapshot that the last one published.
    fn write(past: &mut Past<u32>, head: &mut Arc<u32>, steps: usize) {
        for _ in 0..steps {
            let published = Arc::clone(head);
            *past.make_mut(head) += 1;
            drop(published);
        }
    }

    /// Snapshots of so many readers, one of each step.
    fn read(past: &mut Past<u32>, head: &mut Arc<u32>, readers: usize) -> Vec<Arc<u32>> {
        let step = |_| {
            let snapshot = Arc::clone(head);
            write(past, head, 1);
            snapshot
        };
        (0..readers).map(step).collect()
    }

    #[test]
    fn readers_never_have_the_last_hold() {
        let (mut past, mut head) = (Past::default(), Arc::new(0));
        for (step, snapshot) in (0..).zip(&read(&mut past, &mut head, 100)) {
            assert_eq!((**snapshot, Arc::strong_count(snapshot)), (step, 2));
        }
    }

    #[test]
    fn what_no_one_reads_is_freed_beside_what_is_read_for_long() {
        let (mut past, mut head) = (Past::default(), Arc::new(0));
        for readers in [0, 1, 10, 100] {
            let long = read(&mut past, &mut head, readers);
            write(&mut past, &mut head, 10_000);
            assert!(past.held.len() <= 2 * readers + 3, "{}", past.held.len());
            assert!(long.iter().all(|snapshot| Arc::strong_count(snapshot) == 2));
            drop(long);
            write(&mut past, &mut head, 2 * readers + 3);
            assert!(past.held.len() <= 3, "{}", past.held.len());
        }
    }

    #[test]
    fn what_is_not_shared_changes_in_place_and_frees_what_was() {
        let (mut past, mut head) = (Past::default(), Arc::new(0));
        let long = read(&mut past, &mut head, 10);
        assert!(past.held.len() >= long.len());
        drop(long);
        let place = Arc::as_ptr(&head);
        for _ in 0..10 {
            *past.make_mut(&mut head) += 1;
        }
        assert_eq!((*head, past.held.len()), (20, 0));
        assert_eq!(Arc::as_ptr(&head), place);
    }

    #[test]
    fn a_pause_leaves_what_readers_hold_to_them() {
        let (mut past, mut head) = (Past::default(), Arc::new(0));
        let snapshot = Arc::clone(&head);
        write(&mut past, &mut head, 1);
        past.clear();
        assert_eq!(Arc::strong_count(&snapshot), 1);
    }
}
