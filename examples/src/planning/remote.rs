//! Sources behind a server: an index that other planners could share.

use std::rc::Rc;

use tokio::runtime::{Builder, Runtime};
use wayfold::{Client, IndexHandle, Inserted, Neighbor, Replica, Space, States};
use wayfold_index::Search;

use super::{error::PlanningError, source::NeighborSource};

/// The runtime threads for planners. A planner is a plain loop without async tasks.
///
/// The waiting thread makes the call itself, which saves a thread switch in each round trip. Replicas follow on another
/// thread, because they must proceed while the planner computes.
pub struct Remote {
    calls: Runtime,
    following: Runtime,
    uri: String,
}

impl Remote {
    /// Connects to the server at `uri`. The server must answer now, so that no earlier work is wasted if it is not
    /// there.
    pub fn new(uri: &str) -> Result<Rc<Remote>, PlanningError> {
        let calls = Builder::new_current_thread().enable_all().build();
        let calls = calls.map_err(PlanningError::Threads)?;
        calls.block_on(Client::connect(uri))?;
        let following = Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build();
        Ok(Rc::new(Remote {
            calls,
            following: following.map_err(PlanningError::Threads)?,
            uri: uri.to_owned(),
        }))
    }
}

/// A private index, deleted when it is dropped.
struct Temporary {
    client: Client,
    index: IndexHandle,
}

impl Temporary {
    async fn create(uri: &str, space: &Space) -> Result<Temporary, PlanningError> {
        let client = Client::connect(uri).await?;
        let name = format!("planning-{}", uuid::Uuid::new_v4());
        let index = client.create_index(&name, space).await?;
        Ok(Temporary { client, index })
    }

    async fn delete(&self) {
        // If the server is gone, its indices are gone too.
        let _ = self.client.delete_index(self.index.name()).await;
    }
}

/// The ids of the stored rows.
fn ids(inserted: &Inserted) -> Vec<u64> {
    let rows = inserted.outcomes.iter();
    rows.filter_map(|row| row.id()).collect()
}

/// The server: every search and every insert is a call.
pub struct ServerSource {
    remote: Rc<Remote>,
    own: Temporary,
}

impl ServerSource {
    /// An empty index of the server.
    pub fn new(remote: &Rc<Remote>, space: &Space) -> Result<ServerSource, PlanningError> {
        let own = remote
            .calls
            .block_on(Temporary::create(&remote.uri, space))?;
        Ok(ServerSource {
            remote: Rc::clone(remote),
            own,
        })
    }
}

impl NeighborSource for ServerSource {
    fn insert(&mut self, states: &States) -> Result<Vec<u64>, PlanningError> {
        let insert = self.own.index.insert(states);
        let inserted = self.remote.calls.block_on(insert.into_future())?;
        Ok(ids(&inserted))
    }

    fn search(
        &mut self,
        state: &[f64],
        search: &Search<'_>,
    ) -> Result<Vec<Neighbor>, PlanningError> {
        let index = &self.own.index;
        let found = self.remote.calls.block_on(async move {
            match u32::try_from(search.k) {
                Ok(k) if search.radius.is_finite() => {
                    index.knn([state]).k(k).radius(search.radius).await
                }
                Ok(k) => index.knn([state]).k(k).await,
                Err(_) => index.query([state], search.radius).await,
            }
        })?;
        Ok(found.row(0).iter().collect())
    }
}

impl Drop for ServerSource {
    fn drop(&mut self) {
        self.remote.calls.block_on(self.own.delete());
    }
}

/// A replica. An insert is a call, and returns once the replica has it. A search stays in this process.
pub struct ReplicaSource {
    remote: Rc<Remote>,
    own: Temporary,
    replica: Replica,
}

impl ReplicaSource {
    /// A replica of an empty index of the server.
    pub fn new(remote: &Rc<Remote>, space: &Space) -> Result<ReplicaSource, PlanningError> {
        let (own, replica) = remote.following.block_on(async {
            let own = Temporary::create(&remote.uri, space).await?;
            let replica = own.client.replica(own.index.name()).await?;
            Ok::<_, PlanningError>((own, replica))
        })?;
        Ok(ReplicaSource {
            remote: Rc::clone(remote),
            own,
            replica,
        })
    }
}

impl NeighborSource for ReplicaSource {
    fn insert(&mut self, states: &States) -> Result<Vec<u64>, PlanningError> {
        let insert = self.own.index.insert(states);
        let inserted = self.remote.following.block_on(self.replica.write(insert))?;
        Ok(ids(&inserted))
    }

    fn search(
        &mut self,
        state: &[f64],
        search: &Search<'_>,
    ) -> Result<Vec<Neighbor>, PlanningError> {
        let search = match u32::try_from(search.k) {
            Ok(k) => wayfold::ReplicaSearch::k(k).radius(search.radius),
            Err(_) => wayfold::ReplicaSearch::within(search.radius),
        };
        Ok(self.replica.search(state, &search)?.into_vec())
    }
}

impl Drop for ReplicaSource {
    fn drop(&mut self) {
        self.remote.following.block_on(self.own.delete());
    }
}
