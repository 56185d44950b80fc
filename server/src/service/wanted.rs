//! Which neighbours a request wants: a number and a radius, each fixed or by the size of the index.

use wayfold_index::{Scaling, Search, Space};
use wayfold_proto::v1;

use super::{
    Error, Limits,
    check::{self, Violations},
};

/// What a request says of number and radius.
pub(super) struct Said {
    pub(super) k: Option<u32>,
    pub(super) radius: Option<f64>,
    pub(super) scaling: Option<v1::Scaling>,
}

/// A search that is complete once it is known how many points there are.
#[derive(Clone, Copy)]
pub(super) struct Wanted {
    /// All that does not depend on it.
    pub(super) fixed: Search<'static>,
    scaling: Scaling,
    dimension: usize,
    k_limit: usize,
}

impl Wanted {
    /// Checks what is said, by fields whose paths begin with `prefix`. What is not said is not limited.
    pub(super) fn check(
        prefix: &str,
        said: &Said,
        space: &Space,
        limits: &Limits,
        violations: &mut Violations,
    ) -> Result<Self, Error> {
        let mut fixed = Search::nearest_k(usize::MAX);
        if let Some(k) = said.k {
            fixed.k = check::k(&format!("{prefix}k"), k, limits, violations)?;
        }
        if let Some(radius) = said.radius {
            check::radius(&format!("{prefix}radius"), radius, violations);
            fixed.radius = radius;
        }
        Ok(Self {
            fixed,
            scaling: scaling(prefix, said, violations),
            dimension: space.dimension(),
            k_limit: limits.k,
        })
    }

    /// The search among so many points; refused where its number exceeds the limit.
    pub(super) fn among(&self, points: usize) -> Result<Search<'static>, Error> {
        let search = self.scaled(points);
        if self.scaling.k_factor.is_some() {
            check::k_limit(search.k, self.k_limit)?;
        }
        Ok(search)
    }

    /// A search among so many points for what will most likely do after `rows` more, and what others add meanwhile: for
    /// as many as it takes among an eighth more points. The radius needs no such margin, as it falls.
    pub(super) fn ahead(&self, points: usize, rows: usize) -> Search<'static> {
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

fn scaling(prefix: &str, said: &Said, violations: &mut Violations) -> Scaling {
    let Some(v1::Scaling {
        k_factor,
        radius_factor,
        radius_max,
    }) = said.scaling
    else {
        return Scaling::default();
    };
    let field = |name: &str| format!("{prefix}scaling{name}");
    if k_factor.is_none() && radius_factor.is_none() && radius_max.is_none() {
        violations.add(field(""), "REQUIRED", "set k_factor, radius_factor or both");
    }
    for (name, factor, fixed, is_fixed) in [
        (".k_factor", k_factor, "k", said.k.is_some()),
        (
            ".radius_factor",
            radius_factor,
            "radius",
            said.radius.is_some(),
        ),
    ] {
        if let Some(factor) = factor {
            check::finite(&field(name), factor, violations);
            if is_fixed {
                let text = format!("{prefix}{fixed} is set too; set one of the two");
                violations.add(field(name), "AMBIGUOUS", text);
            }
        }
    }
    if let Some(most) = radius_max {
        check::radius(&field(".radius_max"), most, violations);
        if radius_factor.is_none() {
            let text = format!("radius_max needs it; a radius that is fixed is {prefix}radius");
            violations.add(field(".radius_factor"), "REQUIRED", text);
        }
    }
    Scaling {
        k_factor,
        radius_factor,
        radius_max,
    }
}
