//! The filter of a read, and the neighbours that an insert asks for.

use wayfold_proto::v1::{self, neighbor_spec};

use crate::{
    Include, Radius, Revision, ScaledRadius,
    search::{Bounds, K},
};

/// Limits a read to some of the points. The default admits every point.
///
/// ```
/// use wayfold::Filter;
///
/// // Points of tree 1, whose number is in the lowest two bits of their tags.
/// let tree = Filter::default().tag(0b11, 1);
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Filter {
    pub(crate) tag_mask: u64,
    pub(crate) tag_value: u64,
    pub(crate) since: Option<Revision>,
}

impl Filter {
    /// Only points with `tag & mask == value`.
    pub fn tag(mut self, mask: u64, value: u64) -> Filter {
        (self.tag_mask, self.tag_value) = (mask, value);
        self
    }

    /// Only points whose state was stored after this revision. The read waits until it can see the revision.
    pub fn since(mut self, revision: Revision) -> Filter {
        self.since = Some(revision);
        self
    }

    pub(crate) fn to_message(&self) -> Option<v1::Filter> {
        (*self != Filter::default()).then(|| v1::Filter {
            tag_mask: self.tag_mask,
            tag_value: self.tag_value,
            since_revision: self.since.as_ref().map(Revision::to_message),
        })
    }
}

impl From<K> for neighbor_spec::KForm {
    fn from(k: K) -> neighbor_spec::KForm {
        match k {
            K::Fixed(k) => neighbor_spec::KForm::K(k),
            K::Scaled(factor) => neighbor_spec::KForm::KFactor(factor),
        }
    }
}

impl From<Radius> for neighbor_spec::RadiusForm {
    fn from(radius: Radius) -> neighbor_spec::RadiusForm {
        match radius {
            Radius::Fixed(radius) => neighbor_spec::RadiusForm::Radius(radius),
            Radius::Scaled(ScaledRadius { factor, max }) => {
                neighbor_spec::RadiusForm::ScaledRadius(v1::ScaledRadius { factor, max })
            }
        }
    }
}

/// The neighbours that an insert finds for its rows: those that each row has at the moment it is applied, stored by an
/// earlier mutation or an earlier row.
///
/// ```
/// use wayfold::{Include, NeighborSpec};
///
/// let ten_near = NeighborSpec::k(10).radius(0.5).include(Include::none().states());
/// let all_near = NeighborSpec::within(0.5);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct NeighborSpec {
    pub(crate) bounds: Bounds,
    pub(crate) filter: Filter,
    pub(crate) include: Include,
}

impl NeighborSpec {
    /// The `k` nearest, at least 1.
    pub fn k(k: u32) -> NeighborSpec {
        NeighborSpec::of(Some(K::Fixed(k)), None)
    }

    /// The ⌈factor · ln n⌉ nearest, at least 1, for an index of n points. The server evaluates it, so that workers need
    /// not agree on n. PRM* takes [`Scaling::K_FACTOR`](crate::Scaling::K_FACTOR).
    pub fn k_factor(factor: f64) -> NeighborSpec {
        NeighborSpec::of(Some(K::Scaled(factor)), None)
    }

    /// All at distance `radius` or nearer: a number, or a [`ScaledRadius`].
    pub fn within(radius: impl Into<Radius>) -> NeighborSpec {
        NeighborSpec::of(None, Some(radius.into()))
    }

    /// Only those at distance `radius` or nearer.
    pub fn radius(mut self, radius: impl Into<Radius>) -> NeighborSpec {
        self.bounds.radius = Some(radius.into());
        self
    }

    /// Only some of the points.
    pub fn filter(mut self, filter: Filter) -> NeighborSpec {
        self.filter = filter;
        self
    }

    pub(crate) fn of(k: Option<K>, radius: Option<Radius>) -> NeighborSpec {
        NeighborSpec {
            bounds: Bounds { k, radius },
            filter: Filter::default(),
            include: Include::none(),
        }
    }

    /// The columns of the answer in addition to ids and distances.
    pub fn include(mut self, include: Include) -> NeighborSpec {
        self.include = include;
        self
    }

    pub(crate) fn to_message(&self) -> v1::NeighborSpec {
        v1::NeighborSpec {
            k_form: self.bounds.k.map(Into::into),
            radius_form: self.bounds.radius.map(Into::into),
            filter: self.filter.to_message(),
            include: self.include.to_message(),
        }
    }
}
