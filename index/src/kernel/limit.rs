//! How far a search still looks, in the numbers that the kernels compute.

use crate::{Factor, Space};

/// Turns distances of a space into limits of its *keys*: the weighted sum of squares Σ_i μ_i·d_i² in a space of one
/// group, whose order is that of the distances, and the distance Σ_g w_g·√(Σ_i μ_i·d_i²) itself in a sum of several.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Scale {
    /// 1/w of a single group.
    per_weight: Option<f64>,
    /// Added to a distance: what it may have lost where errors are not relative.
    slack: f64,
    /// The weight of a single group, if the keys of points are exact.
    weight: Option<f64>,
    exact: bool,
    short: Short,
    /// From this key on, a distance may be out of range.
    farthest: f64,
}

/// The relative rounding of a key: a rotation's bound may be too high by 1e-14 of it, and there are the roundings of the
/// limit itself; all else is monotone (see `bound`). Of a point that has moved by rounding, up to 5.8e-14 are the sums of as
/// many coordinates as a space may have.
const MARGIN: f64 = 1.0 + 1e-13;

/// By how much the key of a point may fall short of what its distance makes it, which is not a matter of rounding but of
/// the bound of rotations.
#[derive(Clone, Copy, Debug, Default)]
struct Short {
    /// What the rest of the series is worth: the key, times this, times the eighth power of the largest angle that such a
    /// distance can be ...
    rest: f64,
    /// ... which is the key times this or, in a space of one group, the root of that, ...
    per_weight: f64,
    /// ... and no more than this part of the key.
    most: f64,
    /// The slack of the cosine, and what is lost where errors are not relative.
    slack: f64,
}

/// The series of a squared angle goes on with s⁵/3150 after what is computed of it, and all that follows is worth less than
/// 0.65 of that, since s ≤ 2.
const REST: f64 = 1.7 / 3150.0;

/// The rest in terms of what is computed, at most: at s = 2.
const MOST_REST: f64 = 0.0069;

/// How far a squared angle may lie above the one of the cosine less its slack, in all: 57ε, times π/2, the greatest slope
/// of the angle.
const COSINE_SHORT: f64 = 4e-14;

/// The reach of a key is farther than it by roundings: those of the distance, and three margins.
const REACH_MARGIN: f64 = 1.0 + 1e-12;

impl Scale {
    pub(crate) fn new(space: &Space) -> Self {
        let groups = space.groups();
        let exact = (0..groups.len()).all(|group| rotations(space, group).next().is_none());
        if let [group] = groups {
            let per_weight = 1.0 / group.weight;
            // (√K + δ)² ≤ K·(1 + 1e-13) + δ²·(1 + 1e13): what a distance may have lost, in keys.
            let lost = f64::MIN_POSITIVE * per_weight;
            let mut short = Short {
                slack: 2.0 * (lost * lost * 1.1e13 + f64::MIN_POSITIVE),
                ..Short::default()
            };
            for weight in rotations(space, 0) {
                short.rest += REST;
                short.per_weight = short.per_weight.max(1.0 / weight);
                short.most = MOST_REST;
                short.slack += weight * COSINE_SHORT;
            }
            let farthest = f64::MAX * per_weight;
            return Self {
                farthest: farthest * farthest * 0.99,
                per_weight: Some(per_weight),
                slack: f64::MIN_POSITIVE,
                weight: Some(group.weight),
                exact,
                short,
            };
        }
        // Below the least normal number a square is off by more than its share; a root by the root of that.
        let root = f64::MIN_POSITIVE.sqrt();
        let slack: f64 = groups.iter().map(|group| group.weight * root).sum();
        let slack = slack + f64::MIN_POSITIVE;
        let mut short = Short {
            slack: 4.0 * slack,
            ..Short::default()
        };
        for (at, group) in groups.iter().enumerate() {
            // √(r² + x) − r is less than √x, and less than x/2r.
            let mut slack_2 = 0.0;
            for weight in rotations(space, at) {
                let per_weight = 1.0 / group.weight / weight.sqrt();
                short.rest += REST / 2.0;
                short.per_weight = short.per_weight.max(per_weight);
                short.most = MOST_REST / 2.0;
                slack_2 += weight * COSINE_SHORT;
            }
            short.slack += group.weight * slack_2.sqrt();
        }
        Self {
            per_weight: None,
            slack,
            weight: None,
            exact,
            short,
            farthest: f64::INFINITY,
        }
    }

    /// A key above this belongs to a distance above `worst`.
    pub(crate) fn limit(&self, worst: f64) -> f64 {
        if worst < 0.0 {
            return f64::NEG_INFINITY;
        }
        let raised = (worst + self.slack) * MARGIN;
        match self.per_weight {
            Some(per_weight) => {
                let root = raised * per_weight;
                root * root * MARGIN + f64::MIN_POSITIVE
            }
            None => raised,
        }
    }

    /// A key above this belongs to a greater distance than that of a point of this key: no less than
    /// [`limit`](Self::limit) of its distance, which need not be known.
    #[inline]
    pub(crate) fn reach(&self, key: f64) -> f64 {
        if key >= self.farthest {
            return f64::INFINITY;
        }
        if self.exact {
            return (key + self.short.slack) * REACH_MARGIN;
        }
        // Weights first: the powers of a key alone may be out of range.
        let share = key * self.short.per_weight;
        let square = share * share;
        let fourth = square * square;
        let power = match self.per_weight {
            Some(_) => fourth,
            None => fourth * fourth,
        };
        let rest = (self.short.rest * power).min(self.short.most) * key;
        (key + rest + self.short.slack) * REACH_MARGIN
    }

    /// The limit for keys of points that have moved by up to `error`, a distance, such as by rounding: by the triangle
    /// inequality none of a point with a key up to `limit` is above it.
    #[inline]
    pub(crate) fn loosened(&self, limit: f64, error: f64) -> f64 {
        match self.per_weight {
            // (Not a number where nothing is wanted: no key is up to that.)
            Some(per_weight) => {
                let root = limit.sqrt() + error * per_weight;
                root * root * MARGIN + f64::MIN_POSITIVE
            }
            None => (limit + error) * MARGIN,
        }
    }

    /// The part of a limit that counts for those who want nothing but what is nearer by a factor of `1 + epsilon`.
    pub(crate) fn relaxed(&self, epsilon: f64) -> f64 {
        let part = 1.0 / (1.0 + epsilon);
        match self.per_weight {
            Some(_) => part * part,
            None => part,
        }
    }

    /// The distance of a point of this key, as [`Space::distance`] has it: known where no rotation weighs anything, since
    /// all others' terms are those of the distance, computed by the same operations in the same order.
    #[inline]
    pub(crate) fn distance(&self, key: f64) -> Option<f64> {
        self.exact.then(|| match self.weight {
            Some(weight) => weight * key.sqrt(),
            None => key,
        })
    }
}

/// The weights of a group's rotations, as far as they weigh anything.
fn rotations(space: &Space, group: usize) -> impl Iterator<Item = f64> {
    let parts = space.parts().iter();
    let of_group = parts.filter(move |part| part.group == group && part.factor == Factor::SO3);
    of_group
        .map(|part| part.weight)
        .filter(|&weight| weight > 0.0)
}
