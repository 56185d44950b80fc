//! One index of a server: what is asked of it, and what is remembered of it.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use tonic::transport::Channel;
use wayfold_index::Space;
use wayfold_proto::v1::{self, point_service_client::PointServiceClient};

use crate::{
    Client, Error, Get, IndexInfo, Insert, Knn, KnnAnswers, KnnRequests, Query, Remove,
    ScanRequest, SnapshotRequest, State, States, Update, Verify, WatchRequest, client::within,
};

/// An index of a server, of one uid: when the index is deleted and made anew, the calls of this handle fail with
/// `FAILED_PRECONDITION`, and [`Client::index`] gives a new one.
///
/// Clones are cheap and share what they remember. A handle remembers the last revision it was told of, and its reads
/// see that revision or a later one: whoever wrote through it reads what was written, on any server.
#[derive(Clone, Debug)]
pub struct IndexHandle {
    shared: Arc<Shared>,
    timeout: Duration,
}

#[derive(Debug)]
struct Shared {
    client: Client,
    name: String,
    uid: String,
    space: Space,
    /// The last revision, of `uid`, that a call told of.
    revision: AtomicU64,
}

impl IndexHandle {
    pub(crate) fn new(client: Client, info: IndexInfo) -> IndexHandle {
        let timeout = client.timeout();
        let shared = Shared {
            client,
            name: info.name,
            uid: info.uid,
            space: info.space,
            revision: AtomicU64::new(info.revision),
        };
        IndexHandle {
            shared: Arc::new(shared),
            timeout,
        }
    }

    /// This handle with another timeout for each of its calls. What is remembered stays shared.
    ///
    /// A request that is divided among several calls has the timeout for each.
    pub fn with_timeout(&self, timeout: Duration) -> IndexHandle {
        IndexHandle {
            shared: Arc::clone(&self.shared),
            timeout,
        }
    }

    /// The index's name.
    pub fn name(&self) -> &str {
        &self.shared.name
    }

    /// The index's uid: names the past to which revisions belong.
    pub fn uid(&self) -> &str {
        &self.shared.uid
    }

    /// The space of its states.
    pub fn space(&self) -> &Space {
        &self.shared.space
    }

    /// How many numbers a state has.
    pub fn coordinates(&self) -> usize {
        self.shared.space.coordinates()
    }

    /// The last revision the handle was told of; its reads see this one or a later one.
    pub fn revision(&self) -> u64 {
        self.shared.revision.load(Ordering::Acquire)
    }

    /// Makes the reads from now on see `revision` or a later one: for a revision, of this uid, that another process
    /// told of.
    pub fn see_revision(&self, revision: u64) {
        self.shared.revision.fetch_max(revision, Ordering::AcqRel);
    }

    /// The index as it stands.
    ///
    /// # Errors
    /// `NOT_FOUND`: it was deleted.
    pub async fn info(&self) -> Result<IndexInfo, Error> {
        let info = self.shared.client.index_info(&self.shared.name).await?;
        self.told(&info.uid, info.revision);
        Ok(info)
    }

    /// Inserts states: see [`Insert`].
    pub fn insert<S: State>(&self, states: impl IntoIterator<Item = S>) -> Insert {
        Insert::new(self.clone(), self.collect(states))
    }

    /// Sets tags or payloads of stored points: see [`Update`].
    pub fn update(&self, ids: impl Into<Vec<u64>>) -> Update {
        Update::new(self.clone(), ids.into())
    }

    /// Removes points: see [`Remove`].
    pub fn remove(&self, ids: impl Into<Vec<u64>>) -> Remove {
        Remove::new(self.clone(), ids.into())
    }

    /// Reads points by id: see [`Get`].
    pub fn get(&self, ids: impl Into<Vec<u64>>) -> Get {
        Get::new(self.clone(), ids.into())
    }

    /// The nearest points of each state: see [`Knn`].
    pub fn knn<S: State>(&self, states: impl IntoIterator<Item = S>) -> Knn {
        Knn::new(self.clone(), self.collect(states))
    }

    /// All points within `radius` of each state: see [`Query`].
    pub fn query<S: State>(&self, states: impl IntoIterator<Item = S>, radius: f64) -> Query {
        Query::new(self.clone(), self.collect(states), radius)
    }

    /// All points, in the order of their ids: see [`ScanRequest`].
    pub fn scan(&self) -> ScanRequest {
        ScanRequest::new(self.clone())
    }

    /// Its mutations, as they become readable: see [`WatchRequest`].
    pub fn watch(&self) -> WatchRequest {
        WatchRequest::new(self.clone())
    }

    /// All of it, for a backup or a copy elsewhere: see [`SnapshotRequest`].
    pub fn snapshot(&self) -> SnapshotRequest {
        SnapshotRequest::new(self.clone())
    }

    /// Compares what is searched with what is stored: see [`Verify`].
    pub fn verify(&self) -> Verify {
        Verify::new(self.clone())
    }

    /// Opens a stream on which many [`Knn`] requests can be under way: see [`KnnRequests`].
    ///
    /// # Errors
    /// Those of every call.
    pub async fn stream_knn(&self) -> Result<(KnnRequests, KnnAnswers), Error> {
        crate::request::open_stream(self).await
    }

    fn collect<S: State>(&self, states: impl IntoIterator<Item = S>) -> Result<States, Error> {
        States::collect(self.space(), states)
    }

    pub(crate) fn client(&self) -> &Client {
        &self.shared.client
    }

    pub(crate) fn timeout(&self) -> Duration {
        self.timeout
    }

    /// Where and how new the next read is to look.
    pub(crate) fn read_at(&self) -> v1::ReadAt {
        v1::ReadAt {
            uid: self.shared.uid.clone(),
            min_revision: self.revision(),
        }
    }

    /// Remembers what a call told.
    pub(crate) fn told(&self, uid: &str, revision: u64) {
        if uid == self.shared.uid {
            self.see_revision(revision);
        }
    }

    /// Makes a call about points, with a message made for each try.
    pub(crate) async fn call<Q, A, M, F, Fut>(
        &self,
        call: &'static str,
        message: M,
        send: F,
    ) -> Result<A, Error>
    where
        M: Fn() -> Q,
        F: Fn(PointServiceClient<Channel>, tonic::Request<Q>) -> Fut,
        Fut: Future<Output = Result<tonic::Response<A>, tonic::Status>>,
    {
        let stub = self.shared.client.points();
        let attempt = |remaining| send(stub.clone(), within(remaining, message()));
        self.shared.client.call(call, self.timeout, attempt).await
    }
}
