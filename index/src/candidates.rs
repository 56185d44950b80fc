//! The points that may be answers, held by bounds of their distances until a search ends.
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
    /// The point's distance, or NaN before it is measured.
    pub(crate) distance: f64,
}

/// The greatest `k` whose candidates are kept in a sorted list.
const MAX_SORTED: usize = 64;

/// The least number of candidates between two selections. Fewer would cost more than what the lower limit rules out.
const MIN_BETWEEN_SELECTIONS: usize = 64;

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

/// The candidates for a small `k`, or for a large one.
enum Nearest<'a> {
    /// The `k` candidates with the least upper bounds, in their order.
    Sorted(Vec<Candidate<'a>>),
    /// All candidates in no order. The limit is lowered when there are `full` of them: to select once in a while costs
    /// less for each candidate than a heap, and the limit is only a little greater meanwhile.
    Selected {
        all: Vec<Candidate<'a>>,
        full: usize,
    },
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
                Nearest::Selected {
                    all: Vec::new(),
                    full: k.saturating_add(between_selections(k)),
                }
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
            Nearest::Selected { all, .. } => all.len().min(self.k),
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
            Nearest::Selected { all, full } => {
                all.push(candidate);
                return all.len() >= *full && self.select();
            }
        };
        let Some(last) = last.filter(|&last| last < self.limit) else {
            self.undecided.extend(left);
            return false;
        };
        self.limit = last;
        self.undecided.extend(left.filter(|left| left.key <= last));
        true
    }

    /// Lowers the limit to the `k`-th least upper bound of unordered candidates, and drops those beyond it. Returns
    /// whether that lowered the limit.
    #[cold]
    fn select(&mut self) -> bool {
        let Nearest::Selected { all, full } = &mut self.nearest else {
            return false;
        };
        let mut is_lower = false;
        if all.len() > self.k {
            let (_, last, _) = all
                .select_nth_unstable_by(self.k - 1, |a, b| a.upper_bound.total_cmp(&b.upper_bound));
            let last = last.upper_bound;
            is_lower = last < self.limit;
            self.limit = self.limit.min(last);
            all.retain(|one| one.key <= last);
        }
        *full = all.len().saturating_add(between_selections(self.k));
        is_lower
    }

    /// True if the undecided points are too many to be held.
    #[inline]
    pub(crate) fn is_overfull(&self) -> bool {
        let undecided = match &self.nearest {
            Nearest::Sorted(_) => self.undecided.len(),
            Nearest::Selected { all, .. } => all.len().saturating_sub(self.k),
        };
        undecided >= MAX_UNDECIDED.max(self.len())
    }

    /// Removes and returns all points that may be answers, in no order.
    pub(crate) fn drain(&mut self) -> impl Iterator<Item = Candidate<'a>> + use<'a> {
        self.select();
        let limit = self.limit;
        let least = match &mut self.nearest {
            Nearest::Sorted(least) => std::mem::take(least),
            Nearest::Selected { all, .. } => std::mem::take(all),
        };
        let all = least.into_iter().chain(std::mem::take(&mut self.undecided));
        all.filter(move |one| one.key <= limit)
    }
}

/// The number of candidates between two selections: a selection reads all of them, so that each costs a few reads.
fn between_selections(k: usize) -> usize {
    (k / 4).max(MIN_BETWEEN_SELECTIONS)
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
            k in prop_oneof![0..4usize, 63..67usize, Just(usize::MAX)],
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
            // An unordered list may have a greater limit until it is drained.
            prop_assert!(candidates.limit() >= limit);
            prop_assert!(k > MAX_SORTED || candidates.limit() == limit);
            let left = candidates.drain();
            prop_assert_eq!(candidates.limit(), limit);
            let mut left: Vec<u64> = left.map(|one| one.id).collect();
            left.sort_unstable();
            let may = points.iter().zip(0..).filter(|((key, _), _)| f64::from(*key) <= limit);
            prop_assert_eq!(left, may.map(|(_, id)| id).collect::<Vec<u64>>());
        }
    }
}
