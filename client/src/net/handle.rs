//! One index of a server: its requests, and the last revision that an answer named.

mod waits;

use std::{sync::Arc, time::Duration};

use tokio::time::Instant;
use wayfold_index::Space;
use wayfold_proto::v1;

use crate::{
    Client, Error, Get, IndexInfo, Insert, Knn, KnnAnswers, KnnRequests, Limits, PayloadEncoding,
    Query, Radius, Remove, Revision, ScanRequest, SnapshotRequest, State, States, Update, Verify,
    WatchRequest,
    net::{call::Call, client::within, connections::Connection, newest::Newest, request::MAX_WAIT},
};

/// An index of a server, of one uid: when the index is deleted and created again, the calls of this handle fail with
/// `FAILED_PRECONDITION`, and [`Client::index`] gives a new one.
///
/// Clones are cheap and share the last revision that any answer named. Reads see that revision or a later one: a caller
/// who wrote through the handle reads its own writes, on any server. A client of several servers has one such revision
/// for all its handles of an index.
#[derive(Clone, Debug)]
pub struct IndexHandle {
    shared: Arc<Shared>,
    timeout: Duration,
    /// The end of all its calls together, if they have one.
    deadline: Option<Instant>,
    /// True if reads see what any server has acknowledged.
    latest: bool,
}

#[derive(Debug)]
struct Shared {
    client: Client,
    name: String,
    uid: Arc<str>,
    space: Space,
    payload_encoding: PayloadEncoding,
    /// The last revision, of `uid`, that an answer named.
    newest: Arc<Newest>,
}

impl IndexHandle {
    pub(crate) fn new(client: Client, info: IndexInfo) -> IndexHandle {
        let timeout = client.timeout();
        let shared = Shared {
            newest: client.newest(&info.revision),
            client,
            name: info.name,
            uid: info.revision.uid,
            space: info.space,
            payload_encoding: info.payload_encoding,
        };
        IndexHandle {
            shared: Arc::new(shared),
            timeout,
            deadline: None,
            latest: false,
        }
    }

    /// This handle with another timeout for each of its calls. The last revision stays shared.
    ///
    /// A request that is divided among several calls has the timeout for each. The timeout of the first call includes
    /// the time to read the server's limits.
    pub fn with_timeout(&self, timeout: Duration) -> IndexHandle {
        IndexHandle {
            timeout: timeout.min(MAX_WAIT),
            ..self.clone()
        }
    }

    /// This handle for calls that end at `deadline`: the parts of a divided request share it.
    pub(crate) fn until(&self, deadline: std::time::Instant) -> IndexHandle {
        let now = std::time::Instant::now();
        let timeout = deadline.saturating_duration_since(now).min(MAX_WAIT);
        IndexHandle {
            timeout,
            deadline: Some((now + timeout).into()),
            ..self.clone()
        }
    }

    /// The index's name.
    pub fn name(&self) -> &str {
        &self.shared.name
    }

    /// The index's uid, which identifies the history that revisions count.
    pub fn uid(&self) -> &str {
        &self.shared.uid
    }

    /// The space of its states.
    pub fn space(&self) -> &Space {
        &self.shared.space
    }

    /// The number of coordinates of a state.
    pub fn coordinates(&self) -> usize {
        self.shared.space.coordinates()
    }

    /// How its payloads hold edges, as it declared when it was created.
    pub fn payload_encoding(&self) -> PayloadEncoding {
        self.shared.payload_encoding
    }

    /// The last revision that an answer named; the handle's reads see this one or a later one.
    pub fn revision(&self) -> Revision {
        self.revision_at(self.shared.newest.number())
    }

    /// Revision `number` of the index's uid.
    pub fn revision_at(&self, number: u64) -> Revision {
        Revision::new(Arc::clone(&self.shared.uid), number)
    }

    /// Makes later reads see `revision` or a later one, for a revision that another process wrote.
    ///
    /// # Errors
    /// `FAILED_PRECONDITION`: it is of another uid.
    pub fn see_revision(&self, revision: &Revision) -> Result<(), Error> {
        revision.check_uid(self.uid())?;
        self.note(revision);
        Ok(())
    }

    /// Describes the index at its newest revision.
    ///
    /// # Errors
    /// `NOT_FOUND`: it was deleted.
    pub async fn info(&self) -> Result<IndexInfo, Error> {
        let client = self.client();
        let info = client.index_info_within(self.name(), self.timeout).await?;
        self.note(&info.revision);
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

    /// All points within `radius` of each state, a number or a [`ScaledRadius`](crate::ScaledRadius): see [`Query`].
    pub fn query<S: State>(
        &self,
        states: impl IntoIterator<Item = S>,
        radius: impl Into<Radius>,
    ) -> Query {
        Query::new(self.clone(), self.collect(states), radius.into())
    }

    /// All points, in the order of their ids: see [`ScanRequest`].
    pub fn scan(&self) -> ScanRequest {
        ScanRequest::new(self.clone())
    }

    /// Its mutations, as they become readable: see [`WatchRequest`].
    pub fn watch(&self) -> WatchRequest {
        WatchRequest::new(self.clone())
    }

    /// The whole index, for a backup or a copy elsewhere: see [`SnapshotRequest`].
    pub fn snapshot(&self) -> SnapshotRequest {
        SnapshotRequest::new(self.clone())
    }

    /// Compares the searched points with the stored ones: see [`Verify`].
    pub fn verify(&self) -> Verify {
        Verify::new(self.clone())
    }

    /// Opens a stream on which many [`Knn`] requests can be under way: see [`KnnRequests`].
    ///
    /// # Errors
    /// Those of every call.
    pub async fn stream_knn(&self) -> Result<(KnnRequests, KnnAnswers), Error> {
        crate::net::request::open_stream(self).await
    }

    fn collect<S: State>(&self, states: impl IntoIterator<Item = S>) -> Result<States, Error> {
        States::collect(self.space(), states)
    }

    /// A handle whose searches, gets and scans see every mutation that was acknowledged before they begin, whichever
    /// server of a cluster acknowledged it. Each costs a record in the journal, which all that wait share. Reads of a
    /// server with a journal of its own always see them.
    #[must_use]
    pub fn latest(&self) -> IndexHandle {
        IndexHandle {
            latest: true,
            ..self.clone()
        }
    }

    pub(crate) fn reads_latest(&self) -> bool {
        self.latest
    }

    pub(crate) fn client(&self) -> &Client {
        &self.shared.client
    }

    pub(crate) fn timeout(&self) -> Duration {
        self.timeout
    }

    /// The oldest revision that the next read may see.
    pub(crate) fn min_revision(&self) -> Option<v1::Revision> {
        Some(self.revision().to_message())
    }

    /// Remembers a revision that an answer named, if it is of this uid.
    pub(crate) fn note(&self, revision: &Revision) {
        if *revision.uid == *self.shared.uid {
            self.shared.newest.note(revision.number);
        }
    }

    /// The revision of an answer, which the handle remembers.
    pub(crate) fn answered(
        &self,
        call: &'static str,
        revision: Option<v1::Revision>,
    ) -> Result<Revision, Error> {
        let revision = Revision::from_message(call, revision, &self.shared.uid)?;
        self.note(&revision);
        Ok(revision)
    }

    /// The server's limits, to divide `rows` rows by, and the deadline of the request's first call. A single row cannot
    /// be divided and needs no limits.
    pub(crate) async fn limits(
        &self,
        call: &'static str,
        rows: usize,
    ) -> Result<(Limits, Option<Instant>), Error> {
        let now = Instant::now();
        let deadline = self.deadline.unwrap_or(now + self.timeout);
        let left = deadline.saturating_duration_since(now);
        let limits = match rows {
            0 | 1 => Limits::NONE,
            _ => self.client().limits(call, left).await?,
        };
        Ok((limits, Some(deadline)))
    }

    /// Makes a call about points, with a message made for each attempt. Without a deadline, here or in the handle, its
    /// timeout begins now.
    ///
    /// With several servers, the first call at a server waits there for the newest revision that the handle has seen: a
    /// server that lags may refuse an update of points that it lacks. While a later call is slow, the client waits for that
    /// revision too. Only these waits have a bound below the call's timeout: a long search is not a sign that the server lags.
    pub(crate) async fn call<C: Call>(
        &self,
        deadline: Option<Instant>,
        message: impl Fn() -> C,
    ) -> Result<C::Answer, Error> {
        let deadline = deadline.or(self.deadline);
        let deadline = deadline.unwrap_or_else(|| Instant::now() + self.timeout);
        let (message, mut attempts) = (&message, 0);
        let attempt = |connection: Connection, remaining: Duration| {
            attempts += 1;
            let patience = self.client().patience(self.timeout, attempts);
            async move {
                self.catch_up(&connection, remaining, patience).await?;
                // The wait has taken a part of the time.
                let remaining = deadline.saturating_duration_since(Instant::now());
                let sent = C::send(connection.clone(), within(remaining, message()));
                tokio::select! {
                    answered = sent => answered,
                    lagging = self.lagging(&connection, remaining, patience) => Err(lagging),
                }
            }
        };
        let client = self.client();
        let answer = client.call_at(C::NAME, self.timeout, deadline, attempt);
        answer.await.map(|(answer, _)| answer)
    }

    /// Opens a scan, a snapshot or a verification, without a deadline, which would bound the whole stream. A server lets
    /// such a read wait for 5 s only, so the client waits for the newest revision, and for `since`, before; if there are
    /// several servers, it goes to another one after a while.
    pub(crate) async fn open_stream<A, Fut>(
        &self,
        call: &'static str,
        since: Option<&Revision>,
        open: impl Fn(Connection) -> Fut,
    ) -> Result<A, Error>
    where
        Fut: Future<Output = Result<tonic::Response<A>, tonic::Status>>,
    {
        // The server refuses another uid.
        let since = since.filter(|since| *since.uid == *self.shared.uid);
        let since = since.map_or(0, |since| since.number);
        let mut attempts = 0;
        let attempt = |connection: Connection, remaining: Duration| {
            attempts += 1;
            let newest = self.shared.newest.number();
            // Perhaps no server has a revision that only the caller has named.
            let patience = match since <= newest {
                true => self.client().patience(self.timeout, attempts),
                false => remaining,
            };
            let opened = open(connection.clone());
            async move {
                let revision = newest.max(since);
                self.wait_for(revision, &connection, remaining, patience)
                    .await?;
                opened.await
            }
        };
        self.client().call(call, self.timeout, attempt).await
    }
}
