//! The expected roadmap: the one that a single worker would have built from the same states in the same order. It is
//! computed by brute force, and takes nothing but the states from the index.

use std::collections::BTreeSet;

use wayfold_index::{Linear, PointRef, Search};

use super::{roadmap::Roadmap, scene::Rooms};
use crate::planning::{error::PlanningError, problem::Problem};

/// The edges of each milestone if one worker had made all milestones in the order of their ids, which is the order of
/// their revisions.
pub fn edges(scene: &Rooms, roadmap: &Roadmap) -> Result<Vec<BTreeSet<u64>>, PlanningError> {
    let mut before = Linear::new(scene.space().clone());
    let mut all = Vec::new();
    let mut last = 0;
    for (n, state) in roadmap.states.iter().enumerate() {
        let (id, revision) = (roadmap.ids[n], roadmap.revisions[n]);
        if id != n as u64 || revision < last {
            let problem =
                format!("it is number {n} by its id, of revision {revision} after {last}");
            return Err(PlanningError::Replay { id, problem });
        }
        last = revision;
        let k = (2.0 * std::f64::consts::E * (n as f64).ln())
            .ceil()
            .max(1.0);
        let near = before
            .search(state, &Search::nearest_k(k as usize))
            .expect("canonical states");
        let near = near.neighbors.iter().map(|neighbor| neighbor.id);
        let free = near.filter(|&other| {
            let other = roadmap.states.row(other as usize);
            scene.is_free_way(state, other, &mut 0)
        });
        all.push(free.collect());
        before
            .insert(PointRef {
                id,
                tag: 0,
                revision: 1,
                row: state,
            })
            .expect("canonical states");
    }
    Ok(all)
}

/// The edges of each milestone, as they are stored.
pub fn stored(roadmap: &Roadmap) -> Vec<BTreeSet<u64>> {
    let edges = roadmap.edges.iter();
    edges
        .map(|to| to.iter().map(|&to| roadmap.ids[to]).collect())
        .collect()
}
