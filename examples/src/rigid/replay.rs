//! The expected roadmap: the one that a single worker would have built from the same states in the same order. It is
//! computed by brute force, and takes nothing but the states and their order from the index.

use std::collections::BTreeSet;

use wayfold::Space;

use super::{roadmap::Roadmap, scene::Rooms};
use crate::planning::problem::Problem;

/// The positions of the k(n) nearest of the `n` milestones before the one at position `n`.
pub fn nearest_before(space: &Space, roadmap: &Roadmap, n: usize) -> Vec<usize> {
    let k = (2.0 * std::f64::consts::E * (n as f64).ln())
        .ceil()
        .max(1.0) as usize;
    let state = roadmap.states.row(n);
    let measured = (0..n).map(|at| (space.distance(state, roadmap.states.row(at)), at));
    let mut near: Vec<(f64, usize)> = measured.collect();
    let by_distance = |(a, at): &(f64, usize), (b, other): &(f64, usize)| {
        let by_id = || roadmap.ids[*at].cmp(&roadmap.ids[*other]);
        a.total_cmp(b).then_with(by_id)
    };
    if k < near.len() {
        near.select_nth_unstable_by(k, by_distance);
        near.truncate(k);
    }
    near.sort_unstable_by(by_distance);
    near.into_iter().map(|(_, at)| at).collect()
}

/// The ids at the ends of those motions of the milestone at position `n` to these others that are free.
pub fn free(
    scene: &Rooms,
    roadmap: &Roadmap,
    n: usize,
    others: &[usize],
    checks: &mut u64,
) -> BTreeSet<u64> {
    let (states, state) = (&roadmap.states, roadmap.states.row(n));
    let others = others.iter().copied();
    let free = others.filter(|&other| scene.is_free_way(state, states.row(other), checks));
    free.map(|other| roadmap.ids[other]).collect()
}

/// The edges of each milestone if one worker had made all milestones in the order of the index.
pub fn edges(scene: &Rooms, roadmap: &Roadmap) -> Vec<BTreeSet<u64>> {
    let edges = (0..roadmap.len()).map(|n| {
        let near = nearest_before(scene.space(), roadmap, n);
        free(scene, roadmap, n, &near, &mut 0)
    });
    edges.collect()
}

/// The edges of each milestone, as they are stored.
pub fn stored(roadmap: &Roadmap) -> Vec<BTreeSet<u64>> {
    let edges = roadmap.edges.iter();
    edges
        .map(|to| to.iter().map(|&to| roadmap.ids[to]).collect())
        .collect()
}
