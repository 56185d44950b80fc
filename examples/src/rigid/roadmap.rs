//! The complete roadmap, read from the index, and the search for paths on it.

use std::collections::HashMap;

use wayfold::{Include, IndexHandle, Space, States};

use super::milestone::{self, PENDING};
use crate::planning::{error::PlanningError, path};

/// All milestones and their edges at one revision, in the index's order: by the revisions that stored them, and within
/// one by their ids.
pub struct Roadmap {
    /// The states.
    pub states: States,
    /// The ids.
    pub ids: Vec<u64>,
    /// The worker that made each milestone.
    pub workers: Vec<usize>,
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
            edges: Vec::new(),
            pending: Vec::new(),
        };
        let mut parts = Vec::new();
        let mut scan = index.scan().include(Include::all()).await?;
        while let Some(part) = scan.next().await? {
            parts.push(part);
        }
        let mut points: Vec<_> = parts.iter().flat_map(|part| part.iter()).collect();
        points.sort_unstable_by_key(|point| (point.revision, point.id));
        let ids = points.iter().map(|point| point.id);
        let positions: HashMap<u64, usize> = ids.zip(0..).collect();
        for point in points {
            let id = point.id;
            roadmap.states.push(point.state)?;
            roadmap.ids.push(id);
            roadmap.workers.push(milestone::worker(point.tag));
            roadmap.pending.push(point.tag & PENDING != 0);
            let edges = point.payload.and_then(|payload| milestone::edges(payload));
            let edges = edges.ok_or(PlanningError::Payload { id })?;
            let to = edges.iter().map(|other| positions.get(other).copied());
            let to: Option<Vec<usize>> = to.collect();
            let to = to.ok_or(PlanningError::Payload { id })?;
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
        let at = |id| self.ids.iter().position(|&of| of == id);
        path::shortest(space, &self.states, &self.edges, at(start)?, at(goal)?)
    }
}
