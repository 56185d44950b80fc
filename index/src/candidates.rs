//! The points that may be answers, held by bounds of their distances until a search ends.
//!
//! A distance that includes a rotation costs more than bounding a whole block of points. So points are compared by
//! their *upper bound*: the greatest key that any point as near or nearer can have, which follows from their own key.
//! Only the candidates that are left at the end are measured. A point whose key exceeds the k-th least upper bound is
//! farther than k others, and no answer. A point whose key does not, but whose upper bound does, is held as
//! *undecided*; keys are good bounds, so there are usually none.

use std::{cmp::Ordering, collections::BinaryHeap};

/// A point that may be an answer.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Candidate<'a> {
    /// No point as near as this one, or nearer, has a greater key.
    pub(crate) upper_bound: f64,
    /// The point's own key.
    pub(crate) key: f64,
    pub(crate) id: u64,
    /// The point's block, from its own lane on.
    pub(crate) lane: &'a [f64],
    /// The point's distance, or NaN before it is measured.
    pub(crate) distance: f64,
}

/// The greatest `k` whose candidates are kept in a sorted list. That is cheaper than a heap, which moves an entry along
/// its whole depth at every change.
const MAX_SORTED: usize = 48;

/// The number of undecided points, in addition to one for each of the `k`, at which all are measured. Points at equal
/// distances would otherwise be held without bound.
const MAX_UNDECIDED: usize = 256;

/// The candidates for the `k` nearest.
pub(crate) struct Candidates<'a> {
    k: usize,
    /// A point with a greater key is no answer.
    limit: f64,
    nearest: Nearest<'a>,
    undecided: Vec<Candidate<'a>>,
}

/// The `k` candidates with the least upper bounds.
enum Nearest<'a> {
    Sorted(Vec<Candidate<'a>>),
    Heap(BinaryHeap<ByUpperBound<'a>>),
}

impl<'a> Candidates<'a> {
    /// No candidates yet for the `k` nearest points with a key up to `limit`.
    pub(crate) fn new(k: usize, limit: f64) -> Self {
        Self {
            k,
            limit: if k == 0 { f64::NEG_INFINITY } else { limit },
            nearest: if k <= MAX_SORTED {
                Nearest::Sorted(Vec::with_capacity(k))
            } else {
                Nearest::Heap(BinaryHeap::new())
            },
            undecided: Vec::new(),
        }
    }

    /// A point with a greater key is no answer.
    #[inline]
    pub(crate) fn limit(&self) -> f64 {
        self.limit
    }

    /// The number of candidates that are not undecided, up to `k`.
    pub(crate) fn len(&self) -> usize {
        match &self.nearest {
            Nearest::Sorted(least) => least.len(),
            Nearest::Heap(least) => least.len(),
        }
    }

    /// Adds a point with a key up to the limit. Returns whether that lowered the limit.
    #[inline(always)]
    pub(crate) fn offer(&mut self, candidate: Candidate<'a>) -> bool {
        let is_full = self.len() == self.k;
        let (left, last) = match &mut self.nearest {
            Nearest::Sorted(least) => {
                let mut left = None;
                let mut place = least.len();
                if !is_full {
                    least.push(candidate);
                } else if least[place - 1].upper_bound > candidate.upper_bound {
                    place -= 1;
                    left = Some(least[place]);
                } else {
                    self.undecided.push(candidate);
                    return false;
                }
                while place > 0 && least[place - 1].upper_bound > candidate.upper_bound {
                    least[place] = least[place - 1];
                    place -= 1;
                }
                least[place] = candidate;
                (left, least.get(self.k - 1).map(|last| last.upper_bound))
            }
            Nearest::Heap(least) => push_heap(least, is_full, self.k, candidate),
        };
        let Some(last) = last.filter(|&last| last < self.limit) else {
            self.undecided.extend(left);
            return false;
        };
        self.limit = last;
        self.undecided.extend(left.filter(|left| left.key <= last));
        true
    }

    /// True if the undecided points are too many to be held.
    #[inline]
    pub(crate) fn is_overfull(&self) -> bool {
        self.undecided.len() >= MAX_UNDECIDED.max(self.len())
    }

    /// Removes and returns all points that may be answers, in no order.
    pub(crate) fn drain(&mut self) -> impl Iterator<Item = Candidate<'a>> + use<'a> {
        let limit = self.limit;
        let least = match &mut self.nearest {
            Nearest::Sorted(least) => std::mem::take(least),
            Nearest::Heap(least) => {
                let least = std::mem::take(least).into_vec();
                least.into_iter().map(|one| one.0).collect()
            }
        };
        let all = least.into_iter().chain(std::mem::take(&mut self.undecided));
        all.filter(move |one| one.key <= limit)
    }
}

/// Adds a candidate to the `k` with the least upper bounds. Returns the one that is left over, and the `k`-th upper
/// bound.
fn push_heap<'a>(
    least: &mut BinaryHeap<ByUpperBound<'a>>,
    is_full: bool,
    k: usize,
    candidate: Candidate<'a>,
) -> (Option<Candidate<'a>>, Option<f64>) {
    let mut left = None;
    if !is_full {
        least.push(ByUpperBound(candidate));
    } else if let Some(mut last) = least.peek_mut() {
        left = Some(candidate);
        if candidate.upper_bound < last.0.upper_bound {
            left = Some(std::mem::replace(&mut *last, ByUpperBound(candidate)).0);
        }
    }
    let last = least.peek().filter(|_| least.len() == k);
    (left, last.map(|last| last.0.upper_bound))
}

/// A candidate in the order of the upper bounds.
struct ByUpperBound<'a>(Candidate<'a>);

impl Ord for ByUpperBound<'_> {
    fn cmp(&self, other: &Self) -> Ordering {
        self.0.upper_bound.total_cmp(&other.0.upper_bound)
    }
}

impl PartialOrd for ByUpperBound<'_> {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for ByUpperBound<'_> {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for ByUpperBound<'_> {}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::space::tests::cases;

    proptest! {
        #![proptest_config(cases(500))]

        /// The points left are those with a key up to the `k`-th least upper bound, in whatever order they came.
        #[test]
        fn all_that_may_be_answers_are_left(
            points in prop::collection::vec((0..40u8, prop_oneof![Just(0u8), 0..4u8]), 0..200),
            k in prop_oneof![0..4usize, 47..50usize, Just(usize::MAX)],
            limit in prop_oneof![Just(f64::INFINITY), (0..40u8).prop_map(f64::from)],
        ) {
            let mut candidates = Candidates::new(k, limit);
            let mut bounds = Vec::new();
            for (id, &(key, further)) in points.iter().enumerate() {
                let (key, upper_bound) = (f64::from(key), f64::from(key + further));
                let before = candidates.limit();
                if key > before {
                    continue;
                }
                let lane = &[][..];
                let candidate = Candidate { upper_bound, key, id: id as u64, lane, distance: f64::NAN };
                prop_assert_eq!(candidates.offer(candidate), candidates.limit() < before);
                bounds.push(upper_bound);
                prop_assert_eq!(candidates.len(), bounds.len().min(k));
            }
            bounds.sort_by(f64::total_cmp);
            let kth = k.checked_sub(1).map_or(Some(&f64::NEG_INFINITY), |last| bounds.get(last));
            let limit = kth.map_or(limit, |kth| kth.min(limit));
            prop_assert_eq!(candidates.limit(), limit);
            let mut left: Vec<u64> = candidates.drain().map(|one| one.id).collect();
            left.sort_unstable();
            let may = points.iter().zip(0..).filter(|((key, _), _)| f64::from(*key) <= limit);
            prop_assert_eq!(left, may.map(|(_, id)| id).collect::<Vec<u64>>());
        }
    }
}
