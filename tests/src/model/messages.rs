//! The search of a request, and the neighbours of a response, in the form that the model compares.

use wayfold_index::Search;
use wayfold_proto::v1::{self, Neighbors, neighbor_spec};

use crate::{neighbor_rows, number};

/// The (id, bits of the distance) pairs of each row; no rows if neighbours were not requested.
pub(super) fn expected_rows(
    is_requested: bool,
    neighbors: Option<&Neighbors>,
) -> std::vec::IntoIter<Vec<(u64, u64)>> {
    assert!(is_requested || neighbors.is_none_or(|neighbors| neighbors.neighbor_counts.is_empty()));
    let rows = neighbors.map(neighbor_rows).unwrap_or_default();
    let rows = rows.into_iter().map(|row| {
        let row = row.into_iter();
        row.map(|(id, distance)| (id, distance.to_bits())).collect()
    });
    rows.collect::<Vec<_>>().into_iter()
}

/// The search of a request without scaling.
pub(super) fn search(
    count: Option<neighbor_spec::KForm>,
    radius_form: Option<neighbor_spec::RadiusForm>,
    filter: Option<&v1::Filter>,
) -> Search<'static> {
    let k = match count {
        None => usize::MAX,
        Some(neighbor_spec::KForm::K(k)) => k as usize,
        Some(neighbor_spec::KForm::KFactor(_)) => panic!("{count:?}"),
    };
    let radius = match radius_form {
        None => f64::INFINITY,
        Some(neighbor_spec::RadiusForm::Radius(radius)) => radius,
        Some(neighbor_spec::RadiusForm::ScaledRadius(_)) => panic!("{radius_form:?}"),
    };
    Search {
        radius,
        filter: plain(filter),
        ..Search::nearest_k(k)
    }
}

fn plain(filter: Option<&v1::Filter>) -> wayfold_index::Filter {
    filter.map_or_else(Default::default, |filter| wayfold_index::Filter {
        tag_mask: filter.tag_mask,
        tag_value: filter.tag_value,
        since_revision: number(&filter.since_revision),
    })
}
