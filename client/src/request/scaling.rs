//! Numbers and radii that the server evaluates at the size of its index.

use wayfold_index::Scaling;
use wayfold_proto::v1;

pub(super) fn scaling_message(scaling: Scaling) -> Option<v1::Scaling> {
    (!scaling.is_none()).then_some(v1::Scaling {
        k_factor: scaling.k_factor,
        radius_factor: scaling.radius_factor,
        radius_max: scaling.radius_max,
    })
}

/// The most neighbours that a row can have, for dividing rows among calls: how many points the server has is not known
/// here, but hardly more than this. Should it be wrong, the server refuses what is too large.
pub(super) fn most_neighbors(k: Option<u32>, scaling: Scaling) -> Option<usize> {
    const POINTS: usize = u32::MAX as usize;
    scaling.k(POINTS).or(k.map(|k| k as usize))
}
