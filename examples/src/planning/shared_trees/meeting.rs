//! Tells workers that the trees have met, by a separate index that is empty until then.
//!
//! A worker that connects the trees inserts the state where they meet. All workers hold this index as a shared one: to
//! look whether it has a point costs no call, and the point arrives at once. If several workers connect the trees, the
//! first insert in the index's order counts.

use wayfold::{Include, Index, IndexHandle, InsertOptions, Space};

use super::{
    super::{error::PlanningError, options::TIMEOUT},
    vertex,
};

/// The possible meeting of two trees, for a worker.
pub struct Meeting(Index);

impl Meeting {
    /// The meeting of the trees of this name, which others may have opened before.
    pub fn open(uri: &str, trees: &str, space: &Space) -> Result<Meeting, PlanningError> {
        let index = Index::shared(uri, &name(trees));
        Ok(Meeting(index.create(space).timeout(TIMEOUT).open()?))
    }

    /// Records that the trees meet in this state, at these stored vertices.
    pub fn announce(&self, state: &[f64], vertices: [u64; 2]) -> Result<(), PlanningError> {
        let ids: Vec<u8> = vertices.iter().flat_map(|id| id.to_le_bytes()).collect();
        self.0
            .insert_with(state, InsertOptions::new().payload(&ids))?;
        Ok(self.0.flush()?)
    }

    /// True if a meeting is recorded.
    pub fn has_happened(&self) -> Result<bool, PlanningError> {
        Ok(!self.0.is_empty()?)
    }
}

/// The name of a meeting's index.
pub fn name(trees: &str) -> String {
    format!("{trees}-met")
}

/// The vertices at which the trees have met, of the tree from the start and of the tree from the goal; None if they
/// have not met.
pub async fn vertices(meeting: &IndexHandle) -> Result<Option<[u64; 2]>, PlanningError> {
    // Reads the workers' last revision: their reports are behind it.
    meeting.info().await?;
    let mut first = None;
    let mut scan = meeting.scan().include(Include::all()).await?;
    while let Some(part) = scan.next().await? {
        let met = part.iter();
        let met = met.map(|point| ((point.revision, point.id), point.payload.cloned()));
        first = met.chain(first).min();
    }
    let Some(((_, id), payload)) = first else {
        return Ok(None);
    };
    let ids = payload.and_then(|payload| {
        let (start, goal) = payload.split_at_checked(8)?;
        Some([vertex::parent(start)?, vertex::parent(goal)?])
    });
    ids.map(Some).ok_or(PlanningError::Vertex {
        id,
        problem: "the meeting's payload does not tell of two vertices",
    })
}
