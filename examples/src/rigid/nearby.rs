//! A worker's source of candidates: the milestones that are near enough for an edge.

use wayfold::{
    Include, IndexHandle, Neighbor, Replica, ReplicaSearch as Search, ReplicaView, Revision, Row,
    Scaling,
};

use crate::planning::error::PlanningError;
pub use crate::planning::prm_star::SCALING;

/// The factor by which more than k(n) neighbours are requested. The roadmap, and so k(n), grows while a batch is
/// checked. k(n) grows by this factor when n becomes n^1.1, for example from 1,000 to 2,000. A worker with enough
/// candidates need not search again.
const CANDIDATE_GROWTH: f64 = 1.1;

/// The required columns of a candidate.
pub const STATES: Include = Include::none().states();

/// A milestone that is near enough for an edge.
#[derive(Clone, Debug)]
pub struct Candidate {
    /// Its id.
    pub id: u64,
    /// Its distance.
    pub distance: f64,
    /// Its state.
    pub state: Vec<f64>,
    /// True if the motion is free; None until it is checked.
    pub free: Option<bool>,
}

/// The source of a worker's first candidates.
pub enum Source {
    /// The server, in a call.
    Server,
    /// A replica in the worker's own process. It may be behind the server.
    Replica(Replica),
}

impl Source {
    /// Somewhat more than the k(n) nearest of each state in the source, and the revision after which some may be
    /// missing.
    pub async fn nearest(
        &self,
        index: &IndexHandle,
        states: &[Vec<f64>],
    ) -> Result<(Vec<Vec<Candidate>>, Revision), PlanningError> {
        match self {
            Source::Server => {
                let found = index
                    .knn(states)
                    .k_factor(CANDIDATE_GROWTH * Scaling::K_FACTOR);
                let found = found.include(STATES).await?;
                Ok((found.rows().map(candidates).collect(), found.revision()))
            }
            Source::Replica(replica) => {
                let view = replica.view()?;
                let search = Search::k_factor(CANDIDATE_GROWTH * Scaling::K_FACTOR);
                let nearest = |state: &Vec<f64>| -> Result<Vec<Candidate>, PlanningError> {
                    let found = view.search(state, &search)?;
                    let near = found.iter();
                    Ok(near.filter_map(|near| held(&view, &near)).collect())
                };
                let near: Result<Vec<_>, _> = states.iter().map(nearest).collect();
                Ok((near?, view.revision()))
            }
        }
    }
}

/// The number of found candidates that belong, at least approximately, to the k(n) nearest. These are checked at once.
pub fn without_spare(found: usize) -> usize {
    (found as f64 / CANDIDATE_GROWTH).ceil() as usize
}

/// A candidate found by a replica.
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
    let near = row.iter().enumerate().filter_map(|(at, near)| {
        Some(Candidate {
            id: near.id,
            distance: near.distance,
            state: row.state(at)?.to_vec(),
            free: None,
        })
    });
    near.collect()
}

/// The k nearest of the milestones stored before the given one. These have smaller ids, because ids are assigned in
/// ascending order.
pub async fn nearest_before(
    index: &IndexHandle,
    state: &[f64],
    id: u64,
    k: usize,
) -> Result<Vec<Candidate>, PlanningError> {
    let mut requested = u32::try_from(2 * k).unwrap_or(u32::MAX);
    loop {
        let found = index.knn([state]).k(requested).include(STATES).await?;
        let mut near = candidates(found.row(0));
        let all = near.len() < requested as usize;
        near.retain(|candidate| candidate.id < id);
        if near.len() >= k || all {
            near.truncate(k);
            return Ok(near);
        }
        requested = requested.saturating_mul(2);
    }
}
