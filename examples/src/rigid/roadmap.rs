//! The roadmap as a whole: read from the index, and asked for paths.

use std::collections::HashMap;

use wayfold::{Filter, IndexHandle, Point, Space, States};

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
    /// The worker that made each.
    pub workers: Vec<usize>,
    /// The revision that stored each.
    pub revisions: Vec<u64>,
    /// The edges of each, to positions of milestones before it.
    pub edges: Vec<Vec<usize>>,
    /// Whether each is pending.
    pub pending: Vec<bool>,
}

impl Roadmap {
    /// Reads all of it.
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
        let mut scan = index.scan().payloads().await?;
        while let Some(part) = scan.next_part().await? {
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

    /// How many milestones there are.
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// How many edges there are.
    pub fn edge_count(&self) -> usize {
        self.edges.iter().map(Vec::len).sum()
    }

    /// How near to each other the two nearest milestones are that workers below this number made; none if there are no two.
    /// Measures all pairs.
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

/// Completes what dead workers left pending: afterwards the roadmap is as if they had lived. Returns how many there were.
///
/// Workers that still live lose nothing by it: what they write to complete the same milestones is the same.
pub async fn adopt(index: &IndexHandle, by: &mut Worker<'_>) -> Result<usize, PlanningError> {
    let pending = Filter {
        tag_mask: PENDING,
        tag_value: PENDING,
        ..Filter::default()
    };
    let mut scan = index.scan().filter(pending).payloads().await?;
    let mut adopted = 0;
    while let Some(part) = scan.next_part().await? {
        let found =
            |point: Point<'_>| Pending::found(point).ok_or(PlanningError::Payload { id: point.id });
        let orphans: Result<Vec<Pending>, _> = part.iter().map(found).collect();
        let orphans = orphans?;
        adopted += orphans.len();
        by.complete(orphans).await?;
    }
    Ok(adopted)
}
