//! An index followed and searched in this process: see [`Replica`].
//!
//! One task follows the server (`follow`): it loads all points at a revision (`load`), applies mutations (from
//! `source`: a watch, or publications over Zenoh) to a forest of its own (`merging_forest`), and publishes frozen
//! revisions of it (`view`). Readers search these and never wait for the task. `status` is the task's state.

mod follow;
mod load;
mod merging_forest;
mod request;
mod shared;
mod source;
mod status;
mod validate;
mod view;
mod write;

pub use request::ReplicaRequest;
pub use status::ReplicaStatus;
pub use view::{ReplicaNeighbors, ReplicaView};
pub use write::Write;

use std::{sync::Arc, time::Duration};

use tokio::task::AbortHandle;

use crate::{Error, IndexHandle, Radius, ReplicaSearch, Revision, State};
use shared::Shared;

/// A copy of an index in this process, which follows the server's and answers from its own memory.
///
/// Its answers equal those of the server at the same revision, in ids and in the bits of the distances. Clones share
/// the copy, which follows the index until the last of them is dropped. Reads take `&self` on any number of threads,
/// and wait neither for the server nor for mutations that are being applied.
///
/// ```no_run
/// use std::time::Duration;
/// use wayfold::{Client, Filter, ReplicaSearch, ScaledRadius};
///
/// # async fn example() -> Result<(), Box<dyn std::error::Error>> {
/// let client = Client::connect("http://127.0.0.1:50051").await?;
/// let replica = client.replica("arm").max_staleness(Duration::from_secs(1)).await?;
/// let pose = [0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0];
/// // To the server; when it returns, the replica has the point.
/// let inserted = replica.write(replica.index().insert([pose])).await?;
/// let near = replica.knn(pose, 10)?;
/// println!("{:?} at revision {}", near.nearest(), near.revision());
/// let new = Filter::default().since(inserted.revision);
/// let near = replica.search(pose, &ReplicaSearch::k(10).radius(0.5).filter(new))?;
/// let of_rrt_star = replica.query(pose, ScaledRadius::new(1.1).max(0.5))?;
/// # Ok(())
/// # }
/// ```
///
/// **Lost connections.** When the connection breaks or the server stops, the replica keeps answering from its last
/// whole revision and retries without end, after the pauses of the client's [`RetryPolicy`](crate::RetryPolicy). Then
/// it continues where it stopped. If the server no longer keeps the missing mutations, the replica reads all points
/// again, and answers from the old ones meanwhile. [`Replica::status`] shows all of this.
///
/// **Another index of the same name.** An index that was deleted and created again, was restored, or lost mutations
/// that were not synced has another uid. The replica reads the new one, and the uid of its revisions changes, maybe
/// with the space and to a lower number. An index that is missing for longer than [`ReplicaRequest::missing_for`] ends
/// the replica: then reads fail with [`Error::Ended`].
///
/// **Memory.** It holds ids, states, tags and revisions, but no payloads: read those from the server
/// ([`IndexHandle::get`]).
#[derive(Clone, Debug)]
pub struct Replica {
    owner: Arc<Owner>,
}

/// Ends the task when the last clone of the replica is dropped.
#[derive(Debug)]
struct Owner {
    shared: Arc<Shared>,
    task: AbortHandle,
}

impl Drop for Owner {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Replica {
    fn new(shared: Arc<Shared>, task: AbortHandle) -> Replica {
        Replica {
            owner: Arc::new(Owner { shared, task }),
        }
    }

    fn shared(&self) -> &Shared {
        &self.owner.shared
    }

    /// The handle of its index, of the uid that reads see: to mutate it, and to read payloads.
    pub fn index(&self) -> IndexHandle {
        self.shared().published().index().clone()
    }

    /// The revision that reads see now.
    pub fn revision(&self) -> Revision {
        self.shared().published().revision()
    }

    /// One frozen revision, for several reads of the same points. It keeps their memory until it is dropped.
    ///
    /// # Errors
    /// [`Error::Stale`] and [`Error::Ended`].
    pub fn view(&self) -> Result<ReplicaView, Error> {
        self.shared().check()?;
        Ok(ReplicaView::clone(&self.shared().published()))
    }

    /// The `k` nearest points.
    ///
    /// # Errors
    /// The errors of [`Replica::search`].
    pub fn knn(&self, state: impl State, k: u32) -> Result<ReplicaNeighbors, Error> {
        self.search(state, &ReplicaSearch::k(k))
    }

    /// All points at distance `radius` or nearer, the closed ball: a number, or a
    /// [`ScaledRadius`](crate::ScaledRadius).
    ///
    /// # Errors
    /// The errors of [`Replica::search`].
    pub fn query(
        &self,
        state: impl State,
        radius: impl Into<Radius>,
    ) -> Result<ReplicaNeighbors, Error> {
        self.search(state, &ReplicaSearch::within(radius))
    }

    /// Answers any search, as the server would at the same revision.
    ///
    /// # Errors
    /// Those of the server for the same request: [`Error::Width`], [`Error::Layout`], `INVALID_ARGUMENT` naming the
    /// field, `FAILED_PRECONDITION` for a filter of another uid. [`Error::Behind`]: the filter's revision is above the
    /// replica's. [`Error::Stale`]: the replica has not heard from the server for longer than
    /// [`ReplicaRequest::max_staleness`]. [`Error::Timeout`]: the search took longer than [`ReplicaSearch::timeout`].
    /// [`Error::Ended`].
    pub fn search<S: State>(
        &self,
        state: S,
        search: &ReplicaSearch,
    ) -> Result<ReplicaNeighbors, Error> {
        self.shared().check()?;
        self.shared().published().search(state, search)
    }

    /// Waits until reads see `revision` or a later one, within the client's timeout. Returns the view that they see
    /// then.
    ///
    /// # Errors
    /// [`Error::Timeout`]. `FAILED_PRECONDITION`: the index has another uid. [`Error::Ended`].
    pub async fn at_least(&self, revision: &Revision) -> Result<ReplicaView, Error> {
        let timeout = self.index().timeout();
        self.at_least_within(revision, timeout).await
    }

    /// Acts like [`Replica::at_least`], but waits for at most `timeout`.
    ///
    /// # Errors
    /// The errors of [`Replica::at_least`].
    pub async fn at_least_within(
        &self,
        revision: &Revision,
        timeout: Duration,
    ) -> Result<ReplicaView, Error> {
        self.shared().reached(revision, timeout).await
    }

    /// Sends a mutation, and waits until the replica has it, within the timeout of the mutation's handle.
    ///
    /// # Errors
    /// Those of the mutation, and of [`Replica::at_least`]: after [`Error::Timeout`] of the call `replica` the mutation
    /// has taken effect, and the replica may have it later.
    pub async fn write<W: Write>(&self, mutation: W) -> Result<W::Answer, Error> {
        let timeout = mutation.handle().timeout();
        let answer = mutation.await?;
        self.shared().reached(W::revision(&answer), timeout).await?;
        Ok(answer)
    }

    /// The present status: if the replica follows the server, and how far behind it is.
    pub fn status(&self) -> ReplicaStatus {
        self.shared().status()
    }

    /// Waits for a status for which `wanted` returns true, beginning with the present one. It may miss a status that
    /// lasts only for a moment.
    pub async fn status_where(&self, wanted: impl FnMut(&ReplicaStatus) -> bool) -> ReplicaStatus {
        self.shared().status_where(wanted).await
    }

    /// The age that its points may have: they include everything that the server had published this long ago.
    pub fn staleness(&self) -> Duration {
        self.shared().staleness()
    }
}
