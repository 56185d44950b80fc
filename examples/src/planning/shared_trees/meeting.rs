//! How workers learn that the trees have met: by an index of its own, which holds one point in the end.
//!
//! Who connects the trees inserts the state where they meet, under an id that all agree on: the first one does so, and to
//! the others the server says that it is there already. Everybody watches this index, and is told of its only mutation
//! at once; until then it costs nobody anything, which following all vertices for the sake of one of them would.

use bytes::Bytes;
use wayfold::{Client, Code, Error, IndexHandle, Space, WatchEvent};

use super::{super::error::PlanningError, vertex};

/// The id of the only point.
const ID: u64 = 0;

/// Where the trees of an index may have met.
#[derive(Clone, Debug)]
pub struct Meeting(IndexHandle);

impl Meeting {
    /// Makes what belongs to the trees of this name.
    pub async fn create(
        client: &Client,
        trees: &str,
        space: &Space,
    ) -> Result<Meeting, PlanningError> {
        Ok(Meeting(client.create_index(&name(trees), space).await?))
    }

    /// What belongs to the trees of this name.
    pub async fn open(client: &Client, trees: &str) -> Result<Meeting, PlanningError> {
        Ok(Meeting(client.index(&name(trees)).await?))
    }

    /// The name of its own index.
    pub fn name(&self) -> &str {
        self.0.name()
    }

    /// Says that the trees meet in this state, at these stored vertices, unless somebody has said so before.
    pub async fn announce(&self, state: &[f64], vertices: [u64; 2]) -> Result<(), PlanningError> {
        let ids = vertices.iter().flat_map(|id| id.to_le_bytes());
        let first = self.0.insert([state]).ids([ID]);
        match first.payloads([ids.collect::<Bytes>()]).await {
            Ok(_) => Ok(()),
            Err(error) if error.code() == Code::AlreadyExists => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    /// Waits until somebody has said so.
    pub async fn heard(self) -> Result<(), PlanningError> {
        loop {
            // After a lost connection the next watch waits for the server, as long as the client's calls do.
            match self.0.watch().after(0).await?.next().await {
                Ok(Some(WatchEvent::Mutation(_))) => return Ok(()),
                Ok(Some(WatchEvent::Reset(_)) | None) => return Err(PlanningError::Unfollowed),
                Err(Error::Connection { .. }) => {}
                Err(error) => return Err(error.into()),
            }
        }
    }

    /// The vertices at which the trees have met: of the tree from the start, and of that from the goal; none if they have
    /// not.
    pub async fn vertices(&self) -> Result<Option<[u64; 2]>, PlanningError> {
        let points = match self.0.get([ID]).payloads().await {
            Err(error) if error.code() == Code::NotFound => return Ok(None),
            points => points?,
        };
        let payload = points.point(0).payload;
        let ids = payload.and_then(|payload| {
            let (start, goal) = payload.split_at_checked(8)?;
            Some([vertex::parent(start)?, vertex::parent(goal)?])
        });
        ids.map(Some).ok_or(PlanningError::Vertex {
            id: ID,
            problem: "the meeting's payload does not tell of two vertices",
        })
    }
}

fn name(trees: &str) -> String {
    format!("{trees}-met")
}
