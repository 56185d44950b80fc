//! The number of neighbours and the radius as an index grows: the k(n) and r(n) of PRM* and RRT*.
//!
//! S. Karaman, E. Frazzoli, "Sampling-based algorithms for optimal motion planning", International Journal of Robotics
//! Research 30(7), 2011.

use std::f64::consts::{E, PI};

use crate::Search;

/// Makes the number of neighbours or the radius of a search depend on n, the number of points searched.
///
/// k(n) = ⌈k_factor · ln n⌉ and r(n) = min(radius_max, radius_factor · (ln n / n)^(1/d)), where d is the dimension of
/// the space as a manifold ([`Space::dimension`](crate::Space::dimension)). The default scales neither. n counts all
/// points, also those that a filter excludes.
///
/// The literature's factors are [`Scaling::K_FACTOR`], [`Scaling::k_bound`], [`Scaling::prm_star_bound`] and
/// [`Scaling::rrt_star_bound`]. They are proven for the Euclidean metric. In a product with weights (one group),
/// measure the free space in the metric: the volume is multiplied by μ^(dᵢ/2) for each factor of weight μ and dimension
/// dᵢ, and all of `SO3` has the volume π². In a `sum` of groups a ball is smaller than ζ_d, and the radius has to be
/// larger.
///
/// ```
/// use wayfold_index::{Scaling, Search};
///
/// let scaling = Scaling { k_factor: Some(Scaling::K_FACTOR), ..Scaling::default() };
/// let mut search = Search::nearest_k(1);
/// scaling.apply(&mut search, 1000, 6);
/// // 2e · ln 1000 = 37.55
/// assert_eq!((search.k, search.radius), (38, f64::INFINITY));
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Scaling {
    /// k_PRM or k_RRG: finite, at least 0. Without it the number is not scaled.
    pub k_factor: Option<f64>,
    /// γ_PRM or γ_RRT*, in the units of the metric: finite, at least 0. Without it the radius is not scaled.
    pub radius_factor: Option<f64>,
    /// η: the radius is never above this, at least 0. RRT* takes how far it steers.
    pub radius_max: Option<f64>,
}

impl Scaling {
    /// 2e: more than [`Scaling::k_bound`] in every dimension above 1, and the bound itself in one dimension. The
    /// paper's choice for all problems.
    pub const K_FACTOR: f64 = 2.0 * E;

    /// True if it scales neither.
    pub fn is_none(&self) -> bool {
        *self == Scaling::default()
    }

    /// k(n) = ⌈k_factor · ln n⌉, at least 1 (also of no point and of a single one), if there is a factor.
    pub fn k(&self, points: usize) -> Option<usize> {
        let factor = self.k_factor?;
        if points <= 1 {
            return Some(1);
        }
        let k = (factor * libm::log(points as f64)).ceil();
        // The cast saturates.
        Some((k as usize).max(1))
    }

    /// r(n) = min(radius_max, radius_factor · (ln n / n)^(1/d)), if there is a factor. For at most one point it is
    /// `radius_max`, or infinite without it: the formula's 0 would leave the second point alone.
    ///
    /// It falls from n = 3 on; r(2) is a little below r(3).
    pub fn radius(&self, points: usize, dimension: usize) -> Option<f64> {
        let factor = self.radius_factor?;
        let most = self.radius_max.unwrap_or(f64::INFINITY);
        if points <= 1 {
            return Some(most);
        }
        let n = points as f64;
        Some(most.min(factor * root(libm::log(n) / n, dimension)))
    }

    /// Sets the scaled number and radius of a search among `points` points in a space of this dimension.
    pub fn apply(&self, search: &mut Search<'_>, points: usize, dimension: usize) {
        if let Some(k) = self.k(points) {
            search.k = k;
        }
        if let Some(radius) = self.radius(points, dimension) {
            search.radius = radius;
        }
    }

    /// e(1 + 1/d): above this the k-nearest PRM* and RRG are asymptotically optimal.
    ///
    /// ```
    /// use wayfold_index::Scaling;
    ///
    /// assert_eq!(Scaling::k_bound(1), Scaling::K_FACTOR);
    /// assert!(Scaling::k_bound(6) < Scaling::K_FACTOR);
    /// ```
    pub fn k_bound(dimension: usize) -> f64 {
        E * (1.0 + 1.0 / dimension as f64)
    }

    /// 2(1 + 1/d)^(1/d) · (μ/ζ_d)^(1/d) for a free space of volume μ: above this PRM* and RRG are asymptotically
    /// optimal.
    ///
    /// ```
    /// use wayfold_index::Scaling;
    ///
    /// // The unit square: 2 · √(3/2 / π).
    /// assert!((Scaling::prm_star_bound(2, 1.0) - 1.381_976_6).abs() < 1e-7);
    /// ```
    pub fn prm_star_bound(dimension: usize, free_volume: f64) -> f64 {
        let growth = 1.0 + 1.0 / dimension as f64;
        2.0 * root(
            growth * free_volume / Self::unit_ball_volume(dimension),
            dimension,
        )
    }

    /// (2(1 + 1/d))^(1/d) · (μ/ζ_d)^(1/d) for a free space of volume μ: above this RRT* is asymptotically optimal.
    ///
    /// K. Solovey and others, "Revisiting the asymptotic optimality of RRT*", ICRA 2020, found a gap in the proof, and
    /// prove it for a radius with the exponent 1/(d + 1), which shrinks more slowly and is not offered here.
    ///
    /// ```
    /// use wayfold_index::Scaling;
    ///
    /// // The unit square: √(3 / π).
    /// assert!((Scaling::rrt_star_bound(2, 1.0) - 0.977_205_0).abs() < 1e-7);
    /// ```
    pub fn rrt_star_bound(dimension: usize, free_volume: f64) -> f64 {
        let growth = 2.0 * (1.0 + 1.0 / dimension as f64);
        root(
            growth * free_volume / Self::unit_ball_volume(dimension),
            dimension,
        )
    }

    /// ζ_d: the volume of the unit ball in R^d.
    ///
    /// ```
    /// use wayfold_index::Scaling;
    ///
    /// let of_three = 4.0 / 3.0 * std::f64::consts::PI;
    /// assert!((Scaling::unit_ball_volume(3) - of_three).abs() < 1e-15);
    /// ```
    pub fn unit_ball_volume(dimension: usize) -> f64 {
        // ζ_d = 2π/d · ζ_(d−2), from ζ_0 = 1 and ζ_1 = 2.
        let first = if dimension.is_multiple_of(2) {
            1.0
        } else {
            2.0
        };
        (0..=dimension)
            .rev()
            .step_by(2)
            .take_while(|&d| d >= 2)
            .fold(first, |volume, d| volume * 2.0 * PI / d as f64)
    }
}

/// The d-th root, the same bits on every machine.
fn root(x: f64, dimension: usize) -> f64 {
    libm::pow(x, 1.0 / dimension as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn is_near(found: f64, expected: f64) {
        assert!(
            (found - expected).abs() <= 1e-12 * expected,
            "{found} is not {expected}"
        );
    }

    /// By hand: ln 2 = 0.693147, ln 10 = 2.302585, ln 1000 = 6.907755, ln 10^6 = 13.815511; 2e = 5.436564.
    #[test]
    fn the_number_is_the_ceiling_of_the_factor_times_the_logarithm() {
        let k = |factor, points| {
            let scaling = Scaling {
                k_factor: Some(factor),
                ..Scaling::default()
            };
            scaling.k(points).unwrap()
        };
        for (points, expected) in [
            (0, 1),
            (1, 1),
            (2, 4),
            (10, 13),
            (1000, 38),
            (1_000_000, 76),
        ] {
            assert_eq!(k(Scaling::K_FACTOR, points), expected, "{points}");
        }
        assert_eq!((k(1.0, 10), k(1.0, 1000)), (3, 7));
        assert_eq!((k(0.0, 0), k(0.0, 1000)), (1, 1));
        assert_eq!((k(f64::MAX, 1), k(f64::MAX, 2)), (1, usize::MAX));
    }

    /// By hand: (ln 2 / 2) = 0.34657359027997264; (ln 100 / 100) = 0.04605170185988091, whose square root is
    /// 0.21459660262893474 and sixth root 0.598697…: its cube is the square root.
    #[test]
    fn the_radius_is_the_root_of_the_share_of_a_point() {
        let radius = |radius_max, points, dimension| {
            let scaling = Scaling {
                radius_factor: Some(3.0),
                radius_max,
                ..Scaling::default()
            };
            scaling.radius(points, dimension).unwrap()
        };
        is_near(radius(None, 2, 1), 3.0 * 0.346_573_590_279_972_64);
        is_near(radius(None, 100, 1), 3.0 * 0.046_051_701_859_880_91);
        is_near(radius(None, 100, 2), 3.0 * 0.214_596_602_628_934_74);
        let of_six = radius(None, 100, 6) / 3.0;
        is_near(of_six * of_six * of_six, 0.214_596_602_628_934_74);
        assert_eq!(radius(Some(0.5), 100, 2), 0.5);
        assert_eq!(radius(Some(1.0), 100, 2), radius(None, 100, 2));
        assert_eq!(
            (radius(None, 0, 2), radius(None, 1, 2)),
            (f64::INFINITY, f64::INFINITY)
        );
        assert_eq!(
            (radius(Some(0.5), 0, 2), radius(Some(0.5), 1, 2)),
            (0.5, 0.5)
        );
        let falling: Vec<f64> = (3..200).map(|points| radius(None, points, 3)).collect();
        assert!(falling.is_sorted_by(|a, b| a > b));
        assert!(radius(None, 2, 3) < radius(None, 3, 3));
    }

    #[test]
    fn a_search_without_factors_stays_unchanged() {
        let mut search = Search::nearest_k(7);
        search.radius = 0.25;
        Scaling::default().apply(&mut search, 1000, 3);
        assert_eq!((search.k, search.radius), (7, 0.25));
        let radius_only = Scaling {
            radius_factor: Some(1.0),
            ..Scaling::default()
        };
        radius_only.apply(&mut search, 1, 3);
        assert_eq!((search.k, search.radius), (7, f64::INFINITY));
        assert!(Scaling::default().is_none() && !radius_only.is_none());
    }

    /// ζ: 2, π, 4π/3, π²/2, 8π²/15, π³/6.
    #[test]
    fn the_bounds_are_the_papers() {
        let volumes = [
            2.0,
            PI,
            4.0 * PI / 3.0,
            PI * PI / 2.0,
            8.0 * PI * PI / 15.0,
            PI * PI * PI / 6.0,
        ];
        for (before, volume) in volumes.into_iter().enumerate() {
            is_near(Scaling::unit_ball_volume(before + 1), volume);
        }
        assert!(Scaling::unit_ball_volume(256) > 0.0);
        is_near(Scaling::k_bound(2), 1.5 * E);
        // In one dimension 2 · 2 · μ/2 for both. In three with μ = ζ_3 the cubes are 8 · 4/3 and 2 · 4/3.
        is_near(Scaling::prm_star_bound(1, 3.0), 6.0);
        is_near(Scaling::rrt_star_bound(1, 3.0), 6.0);
        let cube = |x: f64| x * x * x;
        is_near(cube(Scaling::prm_star_bound(3, volumes[2])), 32.0 / 3.0);
        is_near(cube(Scaling::rrt_star_bound(3, volumes[2])), 8.0 / 3.0);
    }
}
