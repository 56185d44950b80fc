//! An index followed and searched in this process: see [`Replica`].
//!
//! One task follows the server: it loads all points at a revision (`load`), applies the mutations that it is told of
//! (`source`: by a watch, or by `publications` over Zenoh) to a forest of its own (`grove`), and publishes frozen revisions of it (`view`), which readers search without ever
//! waiting for it. What it knows of its own state it tells in `status`.

mod follow;
mod grove;
mod load;
#[cfg(feature = "zenoh")]
mod publications;
mod refused;
mod request;
mod shared;
mod source;
mod status;
mod view;
mod write;

pub use request::ReplicaRequest;
pub use status::ReplicaStatus;
pub use view::{Found, ReplicaView};
pub use write::Write;

use std::{sync::Arc, time::Duration};

use tokio::task::AbortHandle;
use wayfold_index::{Scaling, Search};

use crate::{Error, IndexHandle, State};
use shared::Shared;

/// A copy of an index in this process, which follows the server's and answers from its own memory.
///
/// It answers what the server would at the revision that the answer names, in ids and in the bits of the distances.
/// Clones share the copy; it is followed until the last of them is dropped. Reads take `&self` on any number of
/// threads, and wait neither for the server nor for mutations that are being applied.
///
/// ```no_run
/// use std::time::Duration;
/// use wayfold::{Client, Filter, Search};
///
/// # async fn example() -> Result<(), Box<dyn std::error::Error>> {
/// let client = Client::connect("http://127.0.0.1:50051").await?;
/// let replica = client.replica("arm").max_staleness(Duration::from_secs(1)).await?;
/// let pose = [0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0];
/// // To the server; when it returns, the replica has the point.
/// let inserted = replica.write(replica.index().insert([pose])).await?;
/// let found = replica.nearest_k(pose, 10)?;
/// println!("{:?} at revision {} of {}", found.neighbors, found.revision, found.uid);
/// let since = Filter { since_revision: inserted.revision - 1, ..Filter::default() };
/// let found = replica.search(pose, &Search { filter: since, ..Search::nearest_r(0.5) })?;
/// # Ok(())
/// # }
/// ```
///
/// **What it survives.** When the connection breaks or the server stops, it goes on answering from the last revision
/// that it had whole, and tries again, without an end, after the pauses of the client's
/// [`RetryPolicy`](crate::RetryPolicy); then it goes on where it stopped. Where the server cannot tell what is missing,
/// it reads all points anew, beside those that it has, and answers from the old ones meanwhile.
/// [`Replica::status`] tells all of this.
///
/// **Another index of the same name.** Where the index was deleted and made anew, restored, or lost what was not
/// synced, it has another uid: the replica reads the new one, and the uid that it tells changes, maybe with the space
/// and to a lower revision. An index that is missing for longer than [`ReplicaRequest::missing_for`] ends the replica:
/// then reads fail with [`Error::Ended`].
///
/// **Memory.** It holds ids, states, tags and revisions, no payloads: those are read from the server
/// ([`IndexHandle::get`]).
#[derive(Clone, Debug)]
pub struct Replica {
    owner: Arc<Owner>,
}

/// Ends the task when the last replica goes.
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

    /// The index that it stands at: of its uid, to mutate it and to read what the replica does not hold.
    pub fn index(&self) -> IndexHandle {
        self.shared().published().index().clone()
    }

    /// The revision that reads see now.
    pub fn revision(&self) -> u64 {
        self.shared().published().revision()
    }

    /// One revision, frozen: for several reads of the same. It holds the memory of its points while it is held.
    ///
    /// # Errors
    /// [`Error::Stale`] and [`Error::Ended`].
    pub fn view(&self) -> Result<ReplicaView, Error> {
        self.shared().check()?;
        Ok(ReplicaView::clone(&self.shared().published()))
    }

    /// The nearest point, if there is one.
    ///
    /// # Errors
    /// As [`Replica::search`].
    pub fn nearest(&self, state: impl State) -> Result<Found, Error> {
        self.nearest_k(state, 1)
    }

    /// The `k` nearest points.
    ///
    /// # Errors
    /// As [`Replica::search`].
    pub fn nearest_k(&self, state: impl State, k: usize) -> Result<Found, Error> {
        self.search(state, &Search::nearest_k(k))
    }

    /// All points at distance `radius` or nearer, the closed ball.
    ///
    /// # Errors
    /// As [`Replica::search`].
    pub fn nearest_r(&self, state: impl State, radius: f64) -> Result<Found, Error> {
        self.search(state, &Search::nearest_r(radius))
    }

    /// Answers any search: k, radius, filter, epsilon, a cap on leaves.
    ///
    /// # Errors
    /// Those that the server has for the same request: [`Error::Width`], [`Error::Layout`], `INVALID_ARGUMENT` naming
    /// the field. [`Error::Behind`]: `since_revision` is above the replica's. [`Error::Stale`]: nothing was heard of
    /// the server for longer than [`ReplicaRequest::max_staleness`]. [`Error::Ended`].
    pub fn search<S: State>(&self, state: S, search: &Search<'_>) -> Result<Found, Error> {
        self.shared().check()?;
        self.shared().published().search(state, search)
    }

    /// Answers a search whose number and radius are scaled by how many points the replica has: what the server answers to
    /// the same scaling at the same revision. What `scaling` has no factor for is as in `search`.
    ///
    /// ```no_run
    /// # fn example(replica: &wayfold::Replica) -> Result<(), wayfold::Error> {
    /// use wayfold::{Scaling, Search};
    ///
    /// let prm_star = Scaling { k_factor: Some(Scaling::K_FACTOR), ..Scaling::default() };
    /// let found = replica.search_scaled([0.1, 0.2], prm_star, &Search::nearest_r(0.5))?;
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// As [`Replica::search`], and `INVALID_ARGUMENT` naming the factor.
    pub fn search_scaled<S: State>(
        &self,
        state: S,
        scaling: Scaling,
        search: &Search<'_>,
    ) -> Result<Found, Error> {
        self.shared().check()?;
        self.shared()
            .published()
            .search_scaled(state, scaling, search)
    }

    /// Waits until reads see `revision`, of the uid that the replica stands at, or a later one, within the client's
    /// timeout. Returns what they see then.
    ///
    /// # Errors
    /// [`Error::Timeout`]. `FAILED_PRECONDITION`: the uid changed. [`Error::Ended`].
    pub async fn at_least(&self, revision: u64) -> Result<ReplicaView, Error> {
        let index = self.index();
        self.at_least_within(revision, index.timeout()).await
    }

    /// As [`Replica::at_least`], within another time.
    ///
    /// # Errors
    /// As [`Replica::at_least`].
    pub async fn at_least_within(
        &self,
        revision: u64,
        timeout: Duration,
    ) -> Result<ReplicaView, Error> {
        let index = self.index();
        self.shared().reached(index.uid(), revision, timeout).await
    }

    /// Sends a mutation, and waits until the replica has it, within the timeout of the mutation's handle.
    ///
    /// # Errors
    /// Those of the mutation, and of [`Replica::at_least`]: after [`Error::Timeout`] of the call `replica` the mutation
    /// has taken effect, and the replica may have it later.
    pub async fn write<W: Write>(&self, mutation: W) -> Result<W::Answer, Error> {
        let index = mutation.handle().clone();
        let answer = mutation.await?;
        let (revision, timeout) = (W::revision(&answer), index.timeout());
        self.shared()
            .reached(index.uid(), revision, timeout)
            .await?;
        Ok(answer)
    }

    /// Whether it follows the server, and how far behind it is.
    pub fn status(&self) -> ReplicaStatus {
        self.shared().status()
    }

    /// Waits for a status of which `wanted` is true: at once, if it is so now. A status that lasts only for a moment
    /// may be missed.
    pub async fn status_where(&self, wanted: impl FnMut(&ReplicaStatus) -> bool) -> ReplicaStatus {
        self.shared().status_where(wanted).await
    }

    /// How old its points may be: everything that the server had published so long ago is in them.
    pub fn staleness(&self) -> Duration {
        self.shared().staleness()
    }
}
