//! Tells workers that the trees have met, by a separate index that finally holds one point.
//!
//! A worker that connects the trees inserts the state where they meet, under a fixed id. The first insert succeeds; the
//! server answers later ones that the point exists. All workers watch this index and receive its only mutation at once.
//! Until then the watch costs nothing, unlike a watch of all vertices.

use bytes::Bytes;
use wayfold::{Client, Code, Error, Include, IndexHandle, Space, WatchEvent};

use super::{super::error::PlanningError, vertex};

/// The id of the only point.
const ID: u64 = 0;

/// The possible meeting of two trees.
#[derive(Clone, Debug)]
pub struct Meeting(IndexHandle);

impl Meeting {
    /// Creates the meeting of the trees of this name.
    pub async fn create(
        client: &Client,
        trees: &str,
        space: &Space,
    ) -> Result<Meeting, PlanningError> {
        Ok(Meeting(client.create_index(&name(trees), space).await?))
    }

    /// The meeting of the trees of this name.
    pub async fn open(client: &Client, trees: &str) -> Result<Meeting, PlanningError> {
        Ok(Meeting(client.index(&name(trees)).await?))
    }

    /// The name of its own index.
    pub fn name(&self) -> &str {
        self.0.name()
    }

    /// Records that the trees meet in this state, at these stored vertices, unless a meeting is already recorded.
    pub async fn announce(&self, state: &[f64], vertices: [u64; 2]) -> Result<(), PlanningError> {
        let ids = vertices.iter().flat_map(|id| id.to_le_bytes());
        let first = self.0.insert([state]).ids([ID]);
        match first.payloads([ids.collect::<Bytes>()]).await {
            Ok(_) => Ok(()),
            Err(error) if error.code() == Code::AlreadyExists => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    /// Waits until a meeting is recorded.
    pub async fn heard(self) -> Result<(), PlanningError> {
        loop {
            // After a lost connection the next watch waits for the server as long as the client's calls wait.
            let watch = self.0.watch().after(self.0.revision_at(0));
            match watch.await?.next().await {
                Ok(Some(WatchEvent::Mutation(_))) => return Ok(()),
                Ok(Some(WatchEvent::Reset(_)) | None) => return Err(PlanningError::Unfollowed),
                Err(Error::Connection { .. }) => {}
                Err(error) => return Err(error.into()),
            }
        }
    }

    /// The vertices at which the trees have met, of the tree from the start and of the tree from the goal; None if they
    /// have not met.
    pub async fn vertices(&self) -> Result<Option<[u64; 2]>, PlanningError> {
        let points = match self.0.get([ID]).include(Include::all()).await {
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
