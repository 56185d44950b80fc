//! What a search holds until its end: the points that may be among the answers, by bounds of their distances.
//!
//! A distance with a rotation takes longer to compute than a whole block of points to bound. So points are compared by
//! their *reach*, the greatest key that a point as near as they, or nearer, can have, which follows from their own key;
//! only those that are left in the end are measured. What has a key above the k-th least reach is farther than k others,
//! and no answer. What has not, and a greater reach, is held beside those: as a rule nothing, for keys are good bounds.

use std::{cmp::Ordering, collections::BinaryHeap};

/// A point that may be an answer.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Candidate<'a> {
    /// Points as near as this one, or nearer, have no greater key.
    pub(crate) reach: f64,
    /// Its own key.
    pub(crate) key: f64,
    pub(crate) id: u64,
    /// The block it stands in, from its own lane on.
    pub(crate) lane: &'a [f64],
    /// Its distance, or NaN before it is measured.
    pub(crate) distance: f64,
}

/// Up to so many are kept in order: cheaper than a heap, whose every change runs from end to end of it.
const IN_ORDER: usize = 48;

/// So many beside the `k`, and as many as the `k`, are worth measuring, or points that all are equally near would be held
/// without bound.
const MOST_BESIDE: usize = 256;

/// Keeps the candidates for the `k` nearest.
pub(crate) struct Candidates<'a> {
    k: usize,
    /// What has a key above this is no answer.
    limit: f64,
    least: Least<'a>,
    beside: Vec<Candidate<'a>>,
}

/// The `k` of least reach.
enum Least<'a> {
    Ascending(Vec<Candidate<'a>>),
    Heap(BinaryHeap<ByReach<'a>>),
}

impl<'a> Candidates<'a> {
    /// For the `k` nearest of those with a key up to `limit`.
    pub(crate) fn new(k: usize, limit: f64) -> Self {
        Self {
            k,
            limit: if k == 0 { f64::NEG_INFINITY } else { limit },
            least: if k <= IN_ORDER {
                Least::Ascending(Vec::with_capacity(k))
            } else {
                Least::Heap(BinaryHeap::new())
            },
            beside: Vec::new(),
        }
    }

    /// What has a key above this is no answer.
    #[inline]
    pub(crate) fn limit(&self) -> f64 {
        self.limit
    }

    /// How many there are, up to `k`.
    pub(crate) fn len(&self) -> usize {
        match &self.least {
            Least::Ascending(least) => least.len(),
            Least::Heap(least) => least.len(),
        }
    }

    /// Keeps a point with a key up to the limit; whether that has made the limit smaller.
    #[inline(always)]
    pub(crate) fn offer(&mut self, candidate: Candidate<'a>) -> bool {
        let is_full = self.len() == self.k;
        let (left, last) = match &mut self.least {
            Least::Ascending(least) => {
                let mut left = None;
                let mut place = least.len();
                if !is_full {
                    least.push(candidate);
                } else if least[place - 1].reach > candidate.reach {
                    place -= 1;
                    left = Some(least[place]);
                } else {
                    // It has a key up to the limit.
                    self.beside.push(candidate);
                    return false;
                }
                while place > 0 && least[place - 1].reach > candidate.reach {
                    least[place] = least[place - 1];
                    place -= 1;
                }
                least[place] = candidate;
                (left, least.get(self.k - 1).map(|last| last.reach))
            }
            Least::Heap(least) => into_heap(least, is_full, self.k, candidate),
        };
        let Some(last) = last.filter(|&last| last < self.limit) else {
            self.beside.extend(left);
            return false;
        };
        self.limit = last;
        self.beside.extend(left.filter(|left| left.key <= last));
        true
    }

    /// Whether so many are held beside the `k` that they should be measured.
    #[inline]
    pub(crate) fn is_crowded(&self) -> bool {
        self.beside.len() >= MOST_BESIDE.max(self.len())
    }

    /// All that may be an answer, in no order.
    pub(crate) fn drain(&mut self) -> impl Iterator<Item = Candidate<'a>> + use<'a> {
        let limit = self.limit;
        let least = match &mut self.least {
            Least::Ascending(least) => std::mem::take(least),
            Least::Heap(least) => {
                let least = std::mem::take(least).into_vec();
                least.into_iter().map(|one| one.0).collect()
            }
        };
        let all = least.into_iter().chain(std::mem::take(&mut self.beside));
        all.filter(move |one| one.key <= limit)
    }
}

/// Keeps the `k` of least reach; what is left over, and the reach of the `k`-th.
fn into_heap<'a>(
    least: &mut BinaryHeap<ByReach<'a>>,
    is_full: bool,
    k: usize,
    candidate: Candidate<'a>,
) -> (Option<Candidate<'a>>, Option<f64>) {
    let mut left = None;
    if !is_full {
        least.push(ByReach(candidate));
    } else if let Some(mut last) = least.peek_mut() {
        left = Some(candidate);
        if candidate.reach < last.0.reach {
            left = Some(std::mem::replace(&mut *last, ByReach(candidate)).0);
        }
    }
    let last = least.peek().filter(|_| least.len() == k);
    (left, last.map(|last| last.0.reach))
}

/// Ordered by reach.
struct ByReach<'a>(Candidate<'a>);

impl Ord for ByReach<'_> {
    fn cmp(&self, other: &Self) -> Ordering {
        self.0.reach.total_cmp(&other.0.reach)
    }
}

impl PartialOrd for ByReach<'_> {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for ByReach<'_> {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for ByReach<'_> {}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::space::tests::cases;

    proptest! {
        #![proptest_config(cases(500))]

        /// What is left is what has a key up to the `k`-th least reach of all, whatever the order of arrival.
        #[test]
        fn all_that_may_be_answers_are_left(
            points in prop::collection::vec((0..40u8, prop_oneof![Just(0u8), 0..4u8]), 0..200),
            k in prop_oneof![0..4usize, 47..50usize, Just(usize::MAX)],
            limit in prop_oneof![Just(f64::INFINITY), (0..40u8).prop_map(f64::from)],
        ) {
            let mut candidates = Candidates::new(k, limit);
            let mut reaches = Vec::new();
            for (id, &(key, further)) in points.iter().enumerate() {
                let (key, reach) = (f64::from(key), f64::from(key + further));
                let before = candidates.limit();
                if key > before {
                    continue;
                }
                let lane = &[][..];
                let candidate = Candidate { reach, key, id: id as u64, lane, distance: f64::NAN };
                prop_assert_eq!(candidates.offer(candidate), candidates.limit() < before);
                reaches.push(reach);
                prop_assert_eq!(candidates.len(), reaches.len().min(k));
            }
            reaches.sort_by(f64::total_cmp);
            let kth = k.checked_sub(1).map_or(Some(&f64::NEG_INFINITY), |last| reaches.get(last));
            let limit = kth.map_or(limit, |kth| kth.min(limit));
            prop_assert_eq!(candidates.limit(), limit);
            let mut left: Vec<u64> = candidates.drain().map(|one| one.id).collect();
            left.sort_unstable();
            let may = points.iter().zip(0..).filter(|((key, _), _)| f64::from(*key) <= limit);
            prop_assert_eq!(left, may.map(|(_, id)| id).collect::<Vec<u64>>());
        }
    }
}
