//! The candidates for a small `k`, held by bounds of their distances.
//!
//! A distance that includes a rotation costs more than bounding a whole block of points. So points are compared by
//! their *upper bound*: the greatest key that any point as near or nearer can have, which follows from their own key.
//! Only the candidates that are left at the end are measured. A point whose key exceeds the k-th least upper bound is
//! farther than k others, and no answer. A point whose key does not, but whose upper bound does, is held as
//! *undecided*; keys are good bounds, so there are usually none.

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
}

/// The number of undecided points at which all are measured. Points at equal distances, or with loose bounds, would
/// otherwise be held without bound.
const MAX_UNDECIDED: usize = 256;

/// The candidates for the `k` nearest, for a small `k`.
pub(crate) struct BoundedCandidates<'a> {
    k: usize,
    /// A point with a greater key is no answer.
    limit: f64,
    /// The `k` candidates with the least upper bounds, in their order.
    least: Vec<Candidate<'a>>,
    undecided: Vec<Candidate<'a>>,
}

impl<'a> BoundedCandidates<'a> {
    /// No candidates yet for the `k` nearest points with a key up to `limit`.
    pub(crate) fn new(k: usize, limit: f64) -> Self {
        Self {
            k,
            limit: if k == 0 { f64::NEG_INFINITY } else { limit },
            least: Vec::with_capacity(k),
            undecided: Vec::new(),
        }
    }

    /// A point with a greater key is no answer.
    #[inline]
    pub(crate) fn limit(&self) -> f64 {
        self.limit
    }

    /// The number of candidates that are not undecided.
    pub(crate) fn len(&self) -> usize {
        self.least.len()
    }

    /// Adds a point with a key up to the limit. Returns whether that lowered the limit.
    #[inline(always)]
    pub(crate) fn offer(&mut self, candidate: Candidate<'a>) -> bool {
        let least = &mut self.least;
        let mut left = None;
        let mut place = least.len();
        if place < self.k {
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
        let last = least.get(self.k - 1).map(|last| last.upper_bound);
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
        self.undecided.len() >= MAX_UNDECIDED
    }

    /// Removes and returns all points that may be answers, in no order.
    pub(crate) fn take(&mut self) -> Vec<Candidate<'a>> {
        let mut all = std::mem::take(&mut self.least);
        all.append(&mut self.undecided);
        all.retain(|one| one.key <= self.limit);
        all
    }
}

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
            k in prop_oneof![0..4usize, 39..42usize],
            limit in prop_oneof![Just(f64::INFINITY), (0..40u8).prop_map(f64::from)],
        ) {
            let mut candidates = BoundedCandidates::new(k, limit);
            let mut bounds = Vec::new();
            for (id, &(key, further)) in points.iter().enumerate() {
                let (key, upper_bound) = (f64::from(key), f64::from(key + further));
                let before = candidates.limit();
                if key > before {
                    continue;
                }
                let lane = &[][..];
                let candidate = Candidate { upper_bound, key, id: id as u64, lane };
                prop_assert_eq!(candidates.offer(candidate), candidates.limit() < before);
                bounds.push(upper_bound);
                prop_assert_eq!(candidates.len(), bounds.len().min(k));
            }
            bounds.sort_by(f64::total_cmp);
            let kth = k.checked_sub(1).map_or(Some(&f64::NEG_INFINITY), |last| bounds.get(last));
            let limit = kth.map_or(limit, |kth| kth.min(limit));
            prop_assert_eq!(candidates.limit(), limit);
            let left = candidates.take();
            let mut left: Vec<u64> = left.iter().map(|one| one.id).collect();
            left.sort_unstable();
            let may = points.iter().zip(0..).filter(|((key, _), _)| f64::from(*key) <= limit);
            prop_assert_eq!(left, may.map(|(_, id)| id).collect::<Vec<u64>>());
        }
    }
}
