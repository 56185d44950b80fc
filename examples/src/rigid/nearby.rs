//! Where a worker's candidates come from: the milestones that are near enough for an edge.

use wayfold::{Include, IndexHandle, Neighbor, Replica, ReplicaView, Row, Scaling, Search};

use crate::planning::error::PlanningError;
pub use crate::planning::prm_star::SCALING;

/// By how much more than k(n) are asked for: while a batch is checked the roadmap grows, and with it k(n). By so much it
/// grows until n has become n^1.1, from 1,000 to 2,000; who has candidates enough need not search again.
const SPARE: f64 = 1.1;

/// What a candidate needs.
pub const STATES: Include = Include {
    states: true,
    tags: false,
    revisions: false,
    payloads: false,
};

/// A milestone that is near enough for an edge.
#[derive(Clone, Debug)]
pub struct Candidate {
    /// Its id.
    pub id: u64,
    /// How far it is.
    pub distance: f64,
    /// Its state.
    pub state: Vec<f64>,
    /// Whether the way is free, once it is known.
    pub free: Option<bool>,
}

/// Where a worker's first candidates come from.
pub enum Source {
    /// The server, in a call.
    Server,
    /// A replica in the worker's own process, as new as it happens to be.
    Replica(Replica),
}

impl Source {
    /// Somewhat more than the k(n) nearest of each state that the source knows, and a revision from which on some may be
    /// missing.
    pub async fn nearest(
        &self,
        index: &IndexHandle,
        states: &[Vec<f64>],
    ) -> Result<(Vec<Vec<Candidate>>, u64), PlanningError> {
        match self {
            Source::Server => {
                let found = index.knn(states).k_scaled(SPARE * Scaling::K_FACTOR);
                let found = found.include(STATES).await?;
                Ok((found.rows().map(candidates).collect(), found.revision()))
            }
            Source::Replica(replica) => {
                let view = replica.view()?;
                let scaling = Scaling {
                    k_factor: Some(SPARE * Scaling::K_FACTOR),
                    ..SCALING
                };
                let nearest = |state: &Vec<f64>| -> Result<Vec<Candidate>, PlanningError> {
                    let found = view.search_scaled(state, scaling, &Search::nearest_k(1))?;
                    let near = found.neighbors.iter();
                    Ok(near.filter_map(|near| held(&view, near)).collect())
                };
                let near: Result<Vec<_>, _> = states.iter().map(nearest).collect();
                Ok((near?, view.revision()))
            }
        }
    }
}

/// How many of so many that were found the k(n) nearest are, or nearly so: those to be checked at once.
pub fn without_spare(found: usize) -> usize {
    (found as f64 / SPARE).ceil() as usize
}

/// A candidate that a replica has found.
fn held(view: &ReplicaView, near: &Neighbor) -> Option<Candidate> {
    Some(Candidate {
        id: near.id,
        distance: near.distance,
        state: view.get(near.id)?.row.to_vec(),
        free: None,
    })
}

/// The candidates in the answer about one state.
pub fn candidates(row: Row<'_>) -> Vec<Candidate> {
    let near = row.iter().enumerate().filter_map(|(at, (id, distance))| {
        Some(Candidate {
            id,
            distance,
            state: row.state(at)?.to_vec(),
            free: None,
        })
    });
    near.collect()
}

/// The k nearest of those that were stored before a milestone: all below its id, as ids are assigned upwards.
pub async fn nearest_before(
    index: &IndexHandle,
    state: &[f64],
    id: u64,
    k: usize,
) -> Result<Vec<Candidate>, PlanningError> {
    let mut asked = u32::try_from(2 * k).unwrap_or(u32::MAX);
    loop {
        let found = index.knn([state]).k(asked).include(STATES).await?;
        let mut near = candidates(found.row(0));
        let all = near.len() < asked as usize;
        near.retain(|candidate| candidate.id < id);
        if near.len() >= k || all {
            near.truncate(k);
            return Ok(near);
        }
        asked = asked.saturating_mul(2);
    }
}
