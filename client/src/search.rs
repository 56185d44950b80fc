//! The number of neighbours and the radius of a search.

use wayfold_index::Scaling;

/// The greatest distance of a neighbour: a number, or a [`ScaledRadius`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Radius {
    /// This distance or nearer, the closed ball.
    Fixed(f64),
    /// A radius by the number of points.
    Scaled(ScaledRadius),
}

impl From<f64> for Radius {
    fn from(radius: f64) -> Radius {
        Radius::Fixed(radius)
    }
}

impl From<ScaledRadius> for Radius {
    fn from(radius: ScaledRadius) -> Radius {
        Radius::Scaled(radius)
    }
}

/// The radius of PRM* and RRT*: r(n) = min(max, factor · (ln n / n)^(1/d)), for an index of n points in a space of
/// dimension d. The index evaluates it, so that workers need not agree on n.
///
/// n counts all points, also those that a filter leaves out. [`Scaling::prm_star_bound`] and
/// [`Scaling::rrt_star_bound`] are the literature's least factors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScaledRadius {
    pub(crate) factor: f64,
    pub(crate) max: Option<f64>,
}

impl ScaledRadius {
    /// With this factor, in the units of the metric: finite, at least 0.
    pub fn new(factor: f64) -> ScaledRadius {
        ScaledRadius { factor, max: None }
    }

    /// At most this radius. RRT* takes the distance that it steers.
    pub fn max(mut self, radius: f64) -> ScaledRadius {
        self.max = Some(radius);
        self
    }
}

/// The greatest number of neighbours.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum K {
    /// This many.
    Fixed(u32),
    /// ⌈factor · ln n⌉.
    Scaled(f64),
}

/// The greatest number of neighbours and the greatest distance; unset is without a limit.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Bounds {
    pub(crate) k: Option<K>,
    pub(crate) radius: Option<Radius>,
}

impl Bounds {
    /// The factors among them.
    pub(crate) fn scaling(&self) -> Scaling {
        let mut scaling = Scaling::default();
        if let Some(K::Scaled(factor)) = self.k {
            scaling.k_factor = Some(factor);
        }
        if let Some(Radius::Scaled(radius)) = self.radius {
            (scaling.radius_factor, scaling.radius_max) = (Some(radius.factor), radius.max);
        }
        scaling
    }

    /// The most neighbours that a row can have, for dividing rows among calls; `None` if it has no limit.
    #[cfg(feature = "net")]
    pub(crate) fn max_neighbors(&self) -> Option<usize> {
        // The client does not know the number of points, and assumes at most this many. If there are more, the server
        // refuses a call that is too large.
        const POINTS: usize = u32::MAX as usize;
        match self.k? {
            K::Fixed(k) => Some(k as usize),
            K::Scaled(_) => self.scaling().k(POINTS),
        }
    }
}
