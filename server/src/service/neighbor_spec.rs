//! Which neighbours a request asks for: a number and a distance, each fixed or set by the size of the index. `Knn`, `Query`
//! and the neighbours of an insert say it in the same words.

use wayfold_index::{Scaling, Search, Space};
use wayfold_proto::v1::neighbor_spec::{Count, Reach};

use super::{
    Error, Limits,
    check::{self, Violations},
};

/// A search that is complete once the number of points is known.
#[derive(Clone, Copy)]
pub(super) struct NeighborSpec {
    /// All that does not depend on the number of points.
    pub(super) fixed: Search<'static>,
    scaling: Scaling,
    dimension: usize,
    k_limit: usize,
}

impl NeighborSpec {
    /// Checks a number and a distance, in fields whose paths begin with `prefix`. None of them is no limit.
    pub(super) fn check(
        prefix: &str,
        count: Option<Count>,
        reach: Option<Reach>,
        space: &Space,
        limits: &Limits,
        violations: &mut Violations,
    ) -> Result<Self, Error> {
        let field = |name: &str| format!("{prefix}{name}");
        let mut fixed = Search::nearest_k(usize::MAX);
        let mut scaling = Scaling::default();
        match count {
            Some(Count::K(k)) => fixed.k = check::k(&field("k"), k, limits, violations)?,
            Some(Count::KFactor(factor)) => {
                check::finite(&field("k_factor"), factor, violations);
                scaling.k_factor = Some(factor);
            }
            None => {}
        }
        match reach {
            Some(Reach::Radius(radius)) => {
                check::radius(&field("radius"), radius, violations);
                fixed.radius = radius;
            }
            Some(Reach::ScaledRadius(scaled)) => {
                check::finite(&field("scaled_radius.factor"), scaled.factor, violations);
                if let Some(max) = scaled.max {
                    check::radius(&field("scaled_radius.max"), max, violations);
                }
                scaling.radius_factor = Some(scaled.factor);
                scaling.radius_max = scaled.max;
            }
            None => {}
        }
        Ok(Self {
            fixed,
            scaling,
            dimension: space.dimension(),
            k_limit: limits.k,
        })
    }

    /// The search among this many points; refused where its number exceeds the limit.
    pub(super) fn among(&self, points: usize) -> Result<Search<'static>, Error> {
        let search = self.scaled(points);
        if self.scaling.k_factor.is_some() {
            check::k_limit(search.k, self.k_limit)?;
        }
        Ok(search)
    }

    /// A search among this many points that most likely suffices after `rows` more and those that others add meanwhile: for
    /// as many as it takes among an eighth more points. The radius needs no such margin, as it falls.
    pub(super) fn prefetch_search(&self, points: usize, rows: usize) -> Search<'static> {
        let mut search = self.scaled(points);
        if let Some(k) = self.scaling.k(points + points / 8 + rows) {
            search.k = k.min(self.k_limit);
        }
        search
    }

    fn scaled(&self, points: usize) -> Search<'static> {
        let mut search = self.fixed;
        self.scaling.apply(&mut search, points, self.dimension);
        search
    }
}
