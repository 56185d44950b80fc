//! The neighbours that `Knn`, `Query` or an insert requests: a number, a distance and a filter. Number and distance are
//! fixed or scaled by the size of the index.

use wayfold_index::{Scaling, Search};
use wayfold_proto::v1::{
    self,
    neighbor_spec::{KForm, RadiusForm},
};

use super::{
    Error, Limits,
    check::{self, Violations},
};
use crate::registry::Hosted;

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
    /// Checks the fields of a request; their paths begin with `prefix`. An unset number or distance is no limit.
    pub(super) fn check(
        prefix: &str,
        request: v1::NeighborSpec,
        hosted: &Hosted,
        limits: &Limits,
        violations: &mut Violations,
    ) -> Result<Self, Error> {
        let field = |name: &str| format!("{prefix}{name}");
        let mut fixed = Search::nearest_k(usize::MAX);
        let mut scaling = Scaling::default();
        match request.k_form {
            Some(KForm::K(k)) => fixed.k = check::k(&field("k"), k, limits, violations)?,
            Some(KForm::KFactor(factor)) => {
                check::finite(&field("k_factor"), factor, violations);
                scaling.k_factor = Some(factor);
            }
            None => {}
        }
        match request.radius_form {
            Some(RadiusForm::Radius(radius)) => {
                check::radius(&field("radius"), radius, violations);
                fixed.radius = radius;
            }
            Some(RadiusForm::ScaledRadius(scaled)) => {
                check::finite(&field("scaled_radius.factor"), scaled.factor, violations);
                if let Some(max) = scaled.max {
                    check::radius(&field("scaled_radius.max"), max, violations);
                }
                scaling.radius_factor = Some(scaled.factor);
                scaling.radius_max = scaled.max;
            }
            None => {}
        }
        fixed.filter = check::filter(&field("filter"), request.filter, hosted, violations)?;
        Ok(Self {
            fixed,
            scaling,
            dimension: hosted.space().dimension(),
            k_limit: limits.max_k,
        })
    }

    /// The search among this many points; fails if its number exceeds the limit.
    pub(super) fn among(&self, points: usize) -> Result<Search<'static>, Error> {
        let search = self.scaled(points);
        if self.scaling.k_factor.is_some() {
            check::k_limit(search.k, self.k_limit)?;
        }
        Ok(search)
    }

    /// A search among this many points that most likely still suffices after `rows` more points and those of concurrent
    /// writers: its number is that for an eighth more points. The radius shrinks with the size and needs no margin.
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
