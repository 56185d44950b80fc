//! Keys: the numbers that the kernels compute, and limits on them.

use crate::{Factor, Space};

/// Maps distances of a space to limits on its *keys*, and back. In a space of one group a key is the weighted sum of
/// squares Σ_i μ_i·d_i², which is ordered as the distances are; in a sum of several groups it is the distance Σ_g
/// w_g·√(Σ_i μ_i·d_i²) itself.
#[derive(Clone, Copy, Debug)]
pub(crate) struct KeyMap {
    /// None in a sum of several groups.
    single_group: Option<SingleGroup>,
    /// Added to a distance: the most that it may have lost where errors are not relative.
    slack: f64,
    /// True if keys determine distances, because no rotation has a weight.
    exact: bool,
    shortfall: Shortfall,
    /// From this key on, a distance may be out of range.
    overflow: f64,
}

#[derive(Clone, Copy, Debug)]
struct SingleGroup {
    weight: f64,
    /// 1/w.
    per_weight: f64,
}

/// The relative rounding of a key. The bound of a rotation may be too high by 1e-14 of it, and the limit has roundings
/// of its own; all else is monotone (see `bound`). Points moved by quantisation add up to 5.8e-14, for as many
/// coordinates as a space may have.
const MARGIN: f64 = 1.0 + 1e-13;

/// The most by which the key of a point may fall short of the key that its distance would make, apart from rounding:
/// the bound of a rotation leaves out the rest of a series.
#[derive(Clone, Copy, Debug, Default)]
struct Shortfall {
    /// The rest is at most the key, times this, times the eighth power of the largest angle at that key.
    rest: f64,
    /// The largest angle is the key times this; in a space of one group, its square is.
    angle_per_key: f64,
    /// The rest is at most this share of the key.
    max_share: f64,
    /// The slack of the cosine, and the losses that are not relative.
    slack: f64,
}

/// The series of a squared angle continues with s⁵/3150 after the computed terms, and all that follows is worth less
/// than 0.65 of that, since s ≤ 2.
const REST: f64 = 1.7 / 3150.0;

/// The greatest rest as a share of the computed terms: at s = 2.
const MAX_REST_SHARE: f64 = 0.0069;

/// The most by which a squared angle may exceed that of its cosine less the slack: 57ε, times π/2, the greatest slope
/// of the angle.
const COSINE_SHORTFALL: f64 = 4e-14;

/// The margin of an upper bound: the roundings of a distance, and three margins.
const BOUND_MARGIN: f64 = 1.0 + 1e-12;

impl KeyMap {
    pub(crate) fn new(space: &Space) -> Self {
        let groups = space.groups();
        let exact = (0..groups.len()).all(|group| rotations(space, group).next().is_none());
        if let [group] = groups {
            let per_weight = 1.0 / group.weight;
            // (√K + δ)² ≤ K·(1 + 1e-13) + δ²·(1 + 1e13) turns the loss of a distance into one of a key.
            let lost = f64::MIN_POSITIVE * per_weight;
            let mut shortfall = Shortfall {
                slack: 2.0 * (lost * lost * 1.1e13 + f64::MIN_POSITIVE),
                ..Shortfall::default()
            };
            for weight in rotations(space, 0) {
                shortfall.rest += REST;
                shortfall.angle_per_key = shortfall.angle_per_key.max(1.0 / weight);
                shortfall.max_share = MAX_REST_SHARE;
                shortfall.slack += weight * COSINE_SHORTFALL;
            }
            let farthest = f64::MAX * per_weight;
            return Self {
                overflow: farthest * farthest * 0.99,
                single_group: Some(SingleGroup {
                    weight: group.weight,
                    per_weight,
                }),
                slack: f64::MIN_POSITIVE,
                exact,
                shortfall,
            };
        }
        // Below the least normal number the error of a square is not relative; a root has the root of that error.
        let root = f64::MIN_POSITIVE.sqrt();
        let slack: f64 = groups.iter().map(|group| group.weight * root).sum();
        let slack = slack + f64::MIN_POSITIVE;
        let mut shortfall = Shortfall {
            slack: 4.0 * slack,
            ..Shortfall::default()
        };
        let mut overflow = f64::INFINITY;
        for (at, group) in groups.iter().enumerate() {
            // √(r² + x) − r is less than √x, and less than x/2r.
            let mut slack_2 = 0.0;
            for weight in rotations(space, at) {
                let angle_per_key = 1.0 / group.weight / weight.sqrt();
                shortfall.rest += REST / 2.0;
                shortfall.angle_per_key = shortfall.angle_per_key.max(angle_per_key);
                shortfall.max_share = MAX_REST_SHARE / 2.0;
                slack_2 += weight * COSINE_SHORTFALL;
                // The sum of squares may overflow where its lower bound does not, whose root is at most 0.35 % less.
                if group.weight > 0.0 {
                    overflow = overflow.min(group.weight * f64::MAX.sqrt() * 0.99);
                }
            }
            shortfall.slack += group.weight * slack_2.sqrt();
        }
        Self {
            single_group: None,
            slack,
            exact,
            shortfall,
            overflow,
        }
    }

    /// The limit for a distance: a point with a greater key is farther than `distance`.
    pub(crate) fn limit(&self, distance: f64) -> f64 {
        if distance < 0.0 {
            return f64::NEG_INFINITY;
        }
        let raised = (distance + self.slack) * MARGIN;
        match self.single_group {
            Some(SingleGroup { per_weight, .. }) => {
                let root = raised * per_weight;
                root * root * MARGIN + f64::MIN_POSITIVE
            }
            None => raised,
        }
    }

    /// The upper bound for a point with this key: a point with a key above the bound is farther than this one. It is no
    /// less than [`limit`](Self::limit) of the point's distance, which need not be known.
    #[inline]
    pub(crate) fn upper_bound(&self, key: f64) -> f64 {
        if key >= self.overflow {
            return f64::INFINITY;
        }
        if self.exact {
            return (key + self.shortfall.slack) * BOUND_MARGIN;
        }
        // Weights first: the powers of a key alone may be out of range.
        let share = key * self.shortfall.angle_per_key;
        let square = share * share;
        let fourth = square * square;
        let power = match self.single_group {
            Some(_) => fourth,
            None => fourth * fourth,
        };
        let rest = (self.shortfall.rest * power).min(self.shortfall.max_share) * key;
        (key + rest + self.shortfall.slack) * BOUND_MARGIN
    }

    /// The limit for points that quantisation has moved by up to `error`, a distance: by the triangle inequality no
    /// point with a key up to `limit` exceeds it after the move.
    #[inline]
    pub(crate) fn expanded(&self, limit: f64, error: f64) -> f64 {
        match self.single_group {
            // (A limit of −∞ makes a NaN, which no key is up to.)
            Some(SingleGroup { per_weight, .. }) => {
                let root = limit.sqrt() + error * per_weight;
                root * root * MARGIN + f64::MIN_POSITIVE
            }
            None => (limit + error) * MARGIN,
        }
    }

    /// The share of a limit up to which a search for `epsilon` visits cells.
    pub(crate) fn epsilon_factor(&self, epsilon: f64) -> f64 {
        let share = 1.0 / (1.0 + epsilon);
        match self.single_group {
            // Not 0: an infinite limit stays one.
            Some(_) => (share * share).max(f64::MIN_POSITIVE),
            None => share,
        }
    }

    /// True if keys determine distances.
    pub(crate) fn is_exact(&self) -> bool {
        self.exact
    }

    /// The distance of a point with this key, as [`Space::distance`] computes it. Known where no rotation has a weight:
    /// all other terms are those of the distance, computed by the same operations in the same order.
    #[inline]
    pub(crate) fn distance(&self, key: f64) -> Option<f64> {
        self.exact.then(|| match self.single_group {
            Some(SingleGroup { weight, .. }) => weight * key.sqrt(),
            None => key,
        })
    }
}

/// The weights above 0 of the rotations in a group.
fn rotations(space: &Space, group: usize) -> impl Iterator<Item = f64> {
    let parts = space.parts().iter();
    let of_group = parts.filter(move |part| part.group == group && part.factor == Factor::SO3);
    of_group
        .map(|part| part.weight)
        .filter(|&weight| weight > 0.0)
}
