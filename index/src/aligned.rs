//! Numbers that begin at a cache line.

use std::ops::{Deref, DerefMut};

/// The numbers in a cache line, and in the widest register.
const LINE: usize = 8;

/// A table of numbers that begins at a cache line, as a table of boxes or blocks should: a load of a register as
/// wide as a line then reads one line. In a table that begins between two lines it reads two, and searches are slower.
#[derive(Debug)]
pub(crate) struct AlignedNumbers {
    /// Padding up to the first cache line, then the table.
    padded: Vec<f64>,
    start: usize,
}

impl AlignedNumbers {
    /// An empty table with room for `len` numbers.
    pub(crate) fn with_capacity(len: usize) -> Self {
        let mut padded = Vec::<f64>::with_capacity(len + LINE - 1);
        let start = padded.as_ptr().align_offset(LINE * size_of::<f64>());
        // Without an alignment a table is slower, and nothing else.
        let start = start.min(LINE - 1);
        padded.resize(start, 0.0);
        Self { padded, start }
    }

    /// A copy with room for `len` numbers in all.
    pub(crate) fn copy_with_room(&self, len: usize) -> Self {
        let mut copy = Self::with_capacity(len.max(self.len()));
        copy.padded.extend_from_slice(self);
        copy
    }

    /// Appends `count` zeros.
    pub(crate) fn add_zeros(&mut self, count: usize) {
        let len = self.len() + count;
        if self.start + len > self.padded.capacity() {
            *self = self.copy_with_room(len.max(2 * self.len()));
        }
        self.padded.resize(self.start + len, 0.0);
    }

    /// Frees the unused capacity.
    pub(crate) fn shrink_to_fit(&mut self) {
        *self = self.clone();
    }

    /// The bytes that the table holds.
    pub(crate) fn memory_bytes(&self) -> usize {
        size_of::<f64>() * self.padded.capacity()
    }
}

/// A copy begins at a cache line too.
impl Clone for AlignedNumbers {
    fn clone(&self) -> Self {
        self.copy_with_room(self.len())
    }
}

impl Deref for AlignedNumbers {
    type Target = [f64];

    #[inline(always)]
    fn deref(&self) -> &[f64] {
        &self.padded[self.start..]
    }
}

impl DerefMut for AlignedNumbers {
    #[inline(always)]
    fn deref_mut(&mut self) -> &mut [f64] {
        &mut self.padded[self.start..]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_stays_at_a_cache_line_as_it_grows_is_copied_and_shrinks() {
        let is_aligned = |table: &AlignedNumbers| (table.as_ptr() as usize).is_multiple_of(64);
        let mut table = AlignedNumbers::with_capacity(0);
        for len in (0..100).map(|at| 16 * at) {
            let expected: Vec<f64> = (0..len).map(f64::from).collect();
            assert_eq!(*table, *expected);
            assert!(is_aligned(&table));
            let mut copy = table.clone();
            assert_eq!(*copy, *expected);
            assert!(is_aligned(&copy));
            copy.add_zeros(16);
            copy.shrink_to_fit();
            assert_eq!(copy[len as usize..], [0.0; 16]);
            assert!(is_aligned(&copy));
            table.add_zeros(16);
            for (number, x) in table[len as usize..].iter_mut().zip(len..) {
                *number = f64::from(x);
            }
        }
    }
}
