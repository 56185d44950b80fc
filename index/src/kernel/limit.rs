//! How far a search still looks, in the numbers that the kernels compute.

use crate::Space;

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
}

/// The relative rounding of a key: a rotation's bound may be too high by 1e-14 of it, and there are the roundings of
/// the limit itself; all else is monotone (see `bound`).
const MARGIN: f64 = 1.0 + 1e-13;

impl Scale {
    pub(crate) fn new(space: &Space) -> Self {
        let groups = space.groups();
        let exact = !space.has_rotations();
        if let [group] = groups {
            return Self {
                per_weight: Some(1.0 / group.weight),
                slack: f64::MIN_POSITIVE,
                weight: Some(group.weight),
                exact,
            };
        }
        // Below the least normal number a square is off by more than its share; a root by the root of that.
        let root = f64::MIN_POSITIVE.sqrt();
        let slack: f64 = groups.iter().map(|group| group.weight * root).sum();
        Self {
            per_weight: None,
            slack: slack + f64::MIN_POSITIVE,
            weight: None,
            exact,
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

    /// The distance of a point of this key, as [`Space::distance`] has it: known where no factor is a rotation, since
    /// all others' terms are those of the distance, computed by the same operations in the same order.
    #[inline]
    pub(crate) fn distance(&self, key: f64) -> Option<f64> {
        self.exact.then(|| match self.weight {
            Some(weight) => weight * key.sqrt(),
            None => key,
        })
    }
}
