//! The complete roadmap, read from the index, and the search for paths on it.

use std::collections::HashMap;

use wayfold::{Filter, Include, IndexHandle, Point, Space, States};

use super::{
    milestone::{self, PENDING},
    worker::{Pending, Worker},
};
use crate::planning::{error::PlanningError, path};

/// All milestones at one revision, in the order of their ids, and their edges.
pub struct Roadmap {
    /// The states.
    pub states: States,
    /// The ids.
    pub ids: Vec<u64>,
    /// The worker that made each milestone.
    pub workers: Vec<usize>,
    /// The revision that stored each milestone.
    pub revisions: Vec<u64>,
    /// The edges of each milestone, as positions of earlier milestones.
    pub edges: Vec<Vec<usize>>,
    /// True for each pending milestone.
    pub pending: Vec<bool>,
}

impl Roadmap {
    /// Reads the whole roadmap.
    pub async fn read(index: &IndexHandle) -> Result<Roadmap, PlanningError> {
        let mut roadmap = Roadmap {
            states: States::new(index.coordinates()),
            ids: Vec::new(),
            workers: Vec::new(),
            revisions: Vec::new(),
            edges: Vec::new(),
            pending: Vec::new(),
        };
        let mut kept = Vec::new();
        let mut scan = index.scan().include(Include::all()).await?;
        while let Some(part) = scan.next().await? {
            for point in part.iter() {
                let edges = point.payload.and_then(|payload| milestone::edges(payload));
                kept.push(edges.ok_or(PlanningError::Payload { id: point.id })?);
                roadmap.states.push(point.state)?;
                roadmap.ids.push(point.id);
                roadmap.workers.push(milestone::worker(point.tag));
                roadmap.revisions.push(point.revision);
                roadmap.pending.push(point.tag & PENDING != 0);
            }
        }
        let positions: HashMap<u64, usize> = roadmap.ids.iter().copied().zip(0..).collect();
        for (id, edges) in roadmap.ids.iter().zip(kept) {
            let to = edges.iter().map(|other| positions.get(other).copied());
            let to: Option<Vec<usize>> = to.collect();
            let to = to.ok_or(PlanningError::Payload { id: *id })?;
            roadmap.edges.push(to);
        }
        Ok(roadmap)
    }

    /// The number of milestones.
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// The number of edges.
    pub fn edge_count(&self) -> usize {
        self.edges.iter().map(Vec::len).sum()
    }

    /// The smallest distance between two milestones made by workers below this number; None if there are fewer than
    /// two. It computes the distances of all pairs.
    pub fn separation(&self, space: &Space, workers: usize) -> Option<f64> {
        let made = self.states.iter().zip(&self.workers);
        let made = made.filter(|(_, worker)| **worker < workers);
        let rows: Vec<&[f64]> = made.map(|(state, _)| state).collect();
        let pairs = rows
            .iter()
            .enumerate()
            .flat_map(|(at, a)| rows[..at].iter().map(move |b| space.distance(a, b)));
        pairs.min_by(f64::total_cmp)
    }

    /// The shortest path on the roadmap between two milestones.
    pub fn path(&self, space: &Space, start: u64, goal: u64) -> Option<Vec<Vec<f64>>> {
        let at = |id| self.ids.binary_search(&id).ok();
        path::shortest(space, &self.states, &self.edges, at(start)?, at(goal)?)
    }
}

/// Completes the milestones that dead workers left pending, with the same result as if the workers had lived. Returns
/// their number.
///
/// Live workers are not disturbed: they would write the same completion.
pub async fn adopt(index: &IndexHandle, by: &mut Worker<'_>) -> Result<usize, PlanningError> {
    let pending = Filter::default().tag(PENDING, PENDING);
    let scan = index.scan().filter(pending);
    let mut scan = scan.include(Include::all()).await?;
    let mut adopted = 0;
    while let Some(part) = scan.next().await? {
        let found =
            |point: Point<'_>| Pending::found(point).ok_or(PlanningError::Payload { id: point.id });
        let orphans: Result<Vec<Pending>, _> = part.iter().map(found).collect();
        let orphans = orphans?;
        adopted += orphans.len();
        by.complete(orphans).await?;
    }
    Ok(adopted)
}
