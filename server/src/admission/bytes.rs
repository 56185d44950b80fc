//! A bound on bytes that are held at a time.

use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering::Relaxed};

/// See the module.
#[derive(Debug)]
pub(crate) struct ByteBudget {
    max: usize,
    held: AtomicUsize,
    /// The requests that found no room.
    refused: AtomicU64,
}

impl ByteBudget {
    /// Room for `max` bytes.
    pub(crate) fn new(max: usize) -> Self {
        let held = AtomicUsize::new(0);
        Self {
            max,
            held,
            refused: AtomicU64::new(0),
        }
    }

    /// The most bytes.
    pub(super) fn max(&self) -> usize {
        self.max
    }

    /// Takes room for more bytes, until they are given back; false if there is not enough, which counts as no refusal.
    pub(crate) fn try_take(&self, bytes: usize) -> bool {
        self.try_take_within(self.max, bytes)
    }

    /// Like [`ByteBudget::try_take`], but at most `most` bytes may be held then.
    pub(super) fn try_take_within(&self, most: usize, bytes: usize) -> bool {
        let add = |held: usize| held.checked_add(bytes).filter(|held| *held <= most);
        self.held.fetch_update(Relaxed, Relaxed, add).is_ok()
    }

    /// The bytes that are held.
    pub(super) fn held(&self) -> usize {
        self.held.load(Relaxed)
    }

    /// The requests that found no room.
    pub(super) fn refused(&self) -> u64 {
        self.refused.load(Relaxed)
    }

    /// Counts a request that found no room.
    pub(crate) fn refuse(&self) {
        self.refused.fetch_add(1, Relaxed);
    }

    /// Takes room for bytes that exist already, beyond the bound too.
    pub(super) fn force_take(&self, bytes: usize) {
        self.held.fetch_add(bytes, Relaxed);
    }

    /// Gives back room that was taken.
    pub(crate) fn release(&self, bytes: usize) {
        self.held.fetch_sub(bytes, Relaxed);
    }
}
