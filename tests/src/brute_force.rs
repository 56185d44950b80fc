//! Brute force over states as an index stores them.

use wayfold_index::{Linear, Neighbor, PointRef, Search};

/// Stores states under these ids, in canonical form.
///
/// # Panics
/// If one is no state of the space.
pub fn store(points: &mut Linear, ids: &[u64], rows: &[f64], tag: u64, revision: u64) {
    let space = points.space().clone();
    for (&id, row) in ids.iter().zip(rows.chunks(space.coordinates())) {
        let mut row = row.to_vec();
        space.canonicalize(&mut row).expect("a state");
        let point = PointRef {
            id,
            tag,
            revision,
            row: &row,
        };
        points.insert(point).expect("a canonical row");
    }
}

/// The neighbours of a state, in canonical form or not, as [`pairs`].
///
/// # Panics
/// If it is no state of the space.
pub fn search(points: &Linear, state: &[f64], search: &Search<'_>) -> Vec<(u64, u64)> {
    let mut state = state.to_vec();
    points.space().canonicalize(&mut state).expect("a state");
    let answer = points.search(&state, search).expect("a canonical row");
    pairs(answer.neighbors)
}

/// Neighbours as their ids and the bits of their distances.
pub fn pairs(neighbors: impl IntoIterator<Item = Neighbor>) -> Vec<(u64, u64)> {
    let neighbors = neighbors.into_iter();
    neighbors.map(|n| (n.id, n.distance.to_bits())).collect()
}
