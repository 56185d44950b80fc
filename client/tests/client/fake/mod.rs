//! A server that answers every call alike, records the requests, and fails as a script says.

use std::{
    collections::VecDeque,
    pin::Pin,
    sync::{Arc, Mutex},
    time::Duration,
};

use futures_util::{Stream, StreamExt, stream};
use tokio::{net::TcpListener, time};
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Request, Response, Status, Streaming, async_trait};
use tonic_types::{ErrorDetails, StatusExt};
use wayfold::{Client, Space};
use wayfold_proto::{
    space,
    v1::{
        self,
        index_service_server::{IndexService, IndexServiceServer},
        point_service_server::PointServiceServer,
    },
};

mod points;

pub(crate) const UID: &str = "the-uid";

/// A revision of the fake's index.
pub(crate) fn revision(number: u64) -> Option<v1::Revision> {
    revision_of(UID, number)
}

pub(crate) fn revision_of(uid: &str, number: u64) -> Option<v1::Revision> {
    let uid = uid.to_owned();
    Some(v1::Revision { uid, number })
}

/// The limits that tests of dividing are written for.
const LIMITS: v1::Limits = v1::Limits {
    max_rows_per_call: 10_000,
    max_ids_per_call: 10_000,
    max_k: 100_000,
    max_request_bytes: 4 * 1024 * 1024,
    max_answer_bytes: 4 * 1024 * 1024,
    max_payload_bytes: 64 * 1024,
    max_indexes: 1_000,
    max_reserved_ids: 1_000,
    max_changed_point_bytes: 64 * 1024 * 1024,
};

/// Returns the failure of a call, by its number, from 0, and its rows; `None` if it succeeds.
type Script = Box<dyn Fn(usize, usize) -> Option<Status> + Send>;

#[derive(Default)]
struct Inner {
    script: Option<Script>,
    calls: usize,
    knn: Vec<v1::KnnRequest>,
    get: Vec<v1::GetRequest>,
    insert: Vec<v1::InsertRequest>,
    remove: Vec<v1::RemoveRequest>,
    /// The points that `get` finds, whose payloads are their ids as text; without them, it finds none.
    stored: Option<Vec<u64>>,
    timeouts: Vec<Option<String>>,
    /// The number of calls for its limits, which no other count includes.
    described: usize,
    /// The time that passes while it answers a call for its limits.
    describing_time: Duration,
    /// Its limits, if they are not [`LIMITS`].
    limits: Option<v1::Limits>,
    /// The revisions of the next answers; later answers repeat the last.
    revisions: VecDeque<u64>,
    /// The uid of its index, if it was made again.
    uid: Option<&'static str>,
    /// The revision of the batches that it takes; without it, it takes none.
    takes_at: Option<u64>,
    /// The number of writer sessions that it has opened.
    sessions: u64,
    /// True if calls wait for ever.
    silent: bool,
    /// The parts of the next snapshots; a snapshot that is not ended waits for ever after its last part.
    snapshot: Vec<v1::SnapshotPart>,
    snapshot_ends: bool,
    verification: Vec<v1::VerifyIndexResponse>,
    /// The messages of the next watches, one after the other; later watches find nothing new, and wait.
    watches: VecDeque<Vec<Result<v1::WatchResponse, Status>>>,
    watched: Vec<v1::WatchRequest>,
    /// The answers of the next scans, one after the other; later scans answer nothing.
    /// A scan that is not ended waits for ever after its last part.
    scans: VecDeque<(Vec<v1::ScanResponse>, bool)>,
}

#[derive(Clone)]
pub(crate) struct Fake {
    pub(crate) uri: String,
    inner: Arc<Mutex<Inner>>,
}

impl Fake {
    pub(crate) async fn start() -> Fake {
        Fake::serve(TcpListener::bind("127.0.0.1:0").await.unwrap())
    }

    pub(crate) fn serve(listener: TcpListener) -> Fake {
        let fake = Fake {
            uri: format!("http://{}", listener.local_addr().unwrap()),
            inner: Arc::default(),
        };
        let points = PointServiceServer::new(fake.clone()).max_decoding_message_size(usize::MAX);
        let serving = tonic::transport::Server::builder()
            .add_service(IndexServiceServer::new(fake.clone()))
            .add_service(points)
            .serve_with_incoming(TcpListenerStream::new(listener));
        tokio::spawn(serving);
        fake
    }

    pub(crate) async fn client(&self) -> Client {
        Client::connect(&self.uri).await.unwrap()
    }

    /// Fails the next `calls` calls as a starting server does.
    pub(crate) fn unavailable(&self, calls: usize) {
        self.fail(move |number, _| {
            (number < calls).then(|| Status::unavailable("the server is starting"))
        });
    }

    /// Fails the calls for which `script` returns a status. It counts calls from now on.
    pub(crate) fn fail(&self, script: impl Fn(usize, usize) -> Option<Status> + Send + 'static) {
        let mut inner = self.inner.lock().unwrap();
        inner.script = Some(Box::new(script));
        inner.calls = 0;
    }

    /// Sets the revisions of the next answers; later answers repeat the last.
    pub(crate) fn tell<const N: usize>(&self, revisions: [u64; N]) {
        self.inner.lock().unwrap().revisions = revisions.into();
    }

    /// Takes batches, as this revision.
    pub(crate) fn takes_batches(&self, revision: u64) {
        self.inner.lock().unwrap().takes_at = Some(revision);
    }

    /// Gives its index another uid.
    pub(crate) fn make_again(&self, uid: &'static str) {
        self.inner.lock().unwrap().uid = Some(uid);
    }

    pub(crate) fn fall_silent(&self) {
        self.inner.lock().unwrap().silent = true;
    }

    /// Sets the parts of snapshots. If `end` is false, a snapshot waits for ever after its last part.
    pub(crate) fn snapshots(&self, parts: &[v1::SnapshotPart], end: bool) {
        let mut inner = self.inner.lock().unwrap();
        (inner.snapshot, inner.snapshot_ends) = (parts.to_vec(), end);
    }

    /// Sets the answers of verifications.
    pub(crate) fn verifies(&self, answers: &[v1::VerifyIndexResponse]) {
        self.inner.lock().unwrap().verification = answers.to_vec();
    }

    /// Sets the messages of the next watch. After them it waits for ever, unless the last is an error.
    pub(crate) fn watch_tells(&self, messages: Vec<Result<v1::WatchResponse, Status>>) {
        self.inner.lock().unwrap().watches.push_back(messages);
    }

    /// Lets the next scan consist of these parts, and then end, or not.
    pub(crate) fn scan_answers(&self, parts: Vec<v1::ScanResponse>, end: bool) {
        self.inner.lock().unwrap().scans.push_back((parts, end));
    }

    pub(crate) fn watch_requests(&self) -> Vec<v1::WatchRequest> {
        self.inner.lock().unwrap().watched.clone()
    }

    /// Lets calls, counted from now, have at most `rows` rows or ids, as a server that was started again may.
    pub(crate) fn limit_rows(&self, rows: u64) {
        self.fail(move |_, found| {
            (found as u64 > rows).then(|| exceeded("max_rows_per_call", rows))
        });
        self.inner.lock().unwrap().limits = Some(v1::Limits {
            max_rows_per_call: rows,
            ..LIMITS
        });
    }

    /// Lets the clock jump ahead by `time` during each call for the limits. Its runtime has a single thread then.
    pub(crate) fn describe_for(&self, time: Duration) {
        self.inner.lock().unwrap().describing_time = time;
    }

    pub(crate) fn times_described(&self) -> usize {
        self.inner.lock().unwrap().described
    }

    /// The number of calls since failures were last set.
    pub(crate) fn calls(&self) -> usize {
        self.inner.lock().unwrap().calls
    }

    pub(crate) fn knn_requests(&self) -> Vec<v1::KnnRequest> {
        self.inner.lock().unwrap().knn.clone()
    }

    pub(crate) fn get_requests(&self) -> Vec<v1::GetRequest> {
        self.inner.lock().unwrap().get.clone()
    }

    pub(crate) fn insert_requests(&self) -> Vec<v1::InsertRequest> {
        self.inner.lock().unwrap().insert.clone()
    }

    pub(crate) fn remove_requests(&self) -> Vec<v1::RemoveRequest> {
        self.inner.lock().unwrap().remove.clone()
    }

    /// Finds these points and no others.
    pub(crate) fn stores(&self, ids: &[u64]) {
        self.inner.lock().unwrap().stored = Some(ids.to_vec());
    }

    /// The ids of each call that read points.
    pub(crate) fn gets(&self) -> Vec<Vec<u64>> {
        let requests = self.get_requests().into_iter();
        requests.map(|request| request.ids).collect()
    }

    /// The `grpc-timeout` of each call.
    pub(crate) fn timeouts(&self) -> Vec<Option<String>> {
        self.inner.lock().unwrap().timeouts.clone()
    }

    /// Counts a call, and fails it if the script says so.
    async fn enter<Q>(&self, request: &Request<Q>, rows: usize) -> Result<u64, Status> {
        let silent = {
            let mut inner = self.inner.lock().unwrap();
            let timeout = request.metadata().get("grpc-timeout");
            inner
                .timeouts
                .push(timeout.map(|value| value.to_str().unwrap().to_owned()));
            inner.calls += 1;
            if let Some(failure) = inner
                .script
                .as_ref()
                .and_then(|script| script(inner.calls - 1, rows))
            {
                return Err(failure);
            }
            inner.silent
        };
        if silent {
            std::future::pending::<()>().await;
        }
        let revisions = &mut self.inner.lock().unwrap().revisions;
        let next = revisions.front().copied().unwrap_or_default();
        if revisions.len() > 1 {
            revisions.pop_front();
        }
        Ok(next)
    }
}

/// The refusal of a request or an answer that is too large, with the details of a real one.
pub(crate) fn too_large(limit: &str) -> Status {
    exceeded(limit, 1 << 40)
}

/// The refusal of a call that exceeds a limit.
pub(crate) fn exceeded(limit: &str, value: u64) -> Status {
    let metadata = [
        ("limit".to_owned(), limit.to_owned()),
        ("value".to_owned(), value.to_string()),
    ];
    let details = ErrorDetails::with_error_info("LIMIT_EXCEEDED", "wayfold", metadata);
    Status::with_error_details(tonic::Code::ResourceExhausted, "too large", details)
}

/// The refusal of a read of points that are not stored. It names two of them.
fn not_found(ids: &[u64]) -> Status {
    let named: Vec<String> = ids.iter().take(2).map(u64::to_string).collect();
    let metadata = [("ids".to_owned(), named.join(","))];
    let details = ErrorDetails::with_error_info("POINTS_NOT_FOUND", "wayfold", metadata);
    Status::with_error_details(tonic::Code::NotFound, "no such points", details)
}

type Answers<A> = Pin<Box<dyn Stream<Item = Result<A, Status>> + Send>>;

/// A stream of these answers, which then ends or waits for ever.
fn answers<A: Send + 'static>(
    answers: impl Iterator<Item = Result<A, Status>> + Send + 'static,
    end: bool,
) -> Response<Answers<A>> {
    let answers = stream::iter(answers);
    Response::new(match end {
        true => Box::pin(answers),
        false => Box::pin(answers.chain(stream::pending())),
    })
}

#[async_trait]
impl IndexService for Fake {
    async fn get_server(
        &self,
        _request: Request<v1::GetServerRequest>,
    ) -> Result<Response<v1::GetServerResponse>, Status> {
        self.inner.lock().unwrap().described += 1;
        let passing = self.inner.lock().unwrap().describing_time;
        if !passing.is_zero() {
            time::pause();
            time::advance(passing).await;
            time::resume();
        }
        Ok(Response::new(v1::GetServerResponse {
            version: "1.2.3".to_owned(),
            durability: v1::Durability::Memory.into(),
            limits: Some(self.inner.lock().unwrap().limits.unwrap_or(LIMITS)),
        }))
    }

    async fn create_index(
        &self,
        request: Request<v1::CreateIndexRequest>,
    ) -> Result<Response<v1::CreateIndexResponse>, Status> {
        self.enter(&request, 0).await?;
        Err(Status::unimplemented("create_index"))
    }

    async fn get_index(
        &self,
        request: Request<v1::GetIndexRequest>,
    ) -> Result<Response<v1::GetIndexResponse>, Status> {
        let number = self.enter(&request, 0).await?;
        let uid = self.inner.lock().unwrap().uid.unwrap_or(UID);
        let index = v1::Index {
            name: request.into_inner().index_name,
            space: Some(space::to_message(&"R1".parse::<Space>().unwrap())),
            revision: revision_of(uid, number),
            ..Default::default()
        };
        Ok(Response::new(v1::GetIndexResponse { index: Some(index) }))
    }

    async fn list_indexes(
        &self,
        request: Request<v1::ListIndexesRequest>,
    ) -> Result<Response<v1::ListIndexesResponse>, Status> {
        self.enter(&request, 0).await?;
        Ok(Response::new(v1::ListIndexesResponse::default()))
    }

    async fn delete_index(
        &self,
        request: Request<v1::DeleteIndexRequest>,
    ) -> Result<Response<v1::DeleteIndexResponse>, Status> {
        self.enter(&request, 0).await?;
        Err(Status::unimplemented("delete_index"))
    }

    type SnapshotIndexStream = Answers<v1::SnapshotIndexResponse>;

    async fn snapshot_index(
        &self,
        request: Request<v1::SnapshotIndexRequest>,
    ) -> Result<Response<Self::SnapshotIndexStream>, Status> {
        self.enter(&request, 0).await?;
        let inner = self.inner.lock().unwrap();
        let parts = inner.snapshot.clone().into_iter();
        let parts = parts.map(|part| Ok(v1::SnapshotIndexResponse { part: Some(part) }));
        Ok(answers(parts, inner.snapshot_ends))
    }

    /// Reads everything, and then fails.
    async fn restore_index(
        &self,
        request: Request<Streaming<v1::RestoreIndexRequest>>,
    ) -> Result<Response<v1::RestoreIndexResponse>, Status> {
        self.enter(&request, 0).await?;
        let mut messages = request.into_inner();
        while messages.message().await?.is_some() {}
        Err(Status::unimplemented("restore_index"))
    }

    type VerifyIndexStream = Answers<v1::VerifyIndexResponse>;

    async fn verify_index(
        &self,
        request: Request<v1::VerifyIndexRequest>,
    ) -> Result<Response<Self::VerifyIndexStream>, Status> {
        self.enter(&request, 0).await?;
        let verification = self.inner.lock().unwrap().verification.clone();
        Ok(answers(verification.into_iter().map(Ok), true))
    }
}
