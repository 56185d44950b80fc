//! A bare tonic server that takes the same messages and returns prepared answers of the same size. It says that it has an
//! index of SE(3), so that `wayfold load` calls it as it calls a server.

use std::{
    collections::HashMap,
    process::ExitCode,
    sync::{Arc, Mutex, PoisonError},
};

use tokio::{net::TcpListener, sync::mpsc};
use tokio_stream::wrappers::{ReceiverStream, TcpListenerStream};
use tonic::{Request, Response, Status, Streaming, transport::Server};
use wayfold_proto::{
    space,
    v1::{
        CreateIndexRequest, CreateIndexResponse, DeleteIndexRequest, DeleteIndexResponse,
        Durability, GetIndexRequest, GetIndexResponse, GetRequest, GetResponse, GetServerRequest,
        GetServerResponse, Index, InsertRequest, InsertResponse, KnnRequest, KnnResponse, Limits,
        ListIndexesRequest, ListIndexesResponse, Neighbors, OpenSessionRequest,
        OpenSessionResponse, Outcome, QueryRequest, QueryResponse, RemoveRequest, RemoveResponse,
        RestoreIndexRequest, RestoreIndexResponse, Revision, ScanRequest, ScanResponse,
        SnapshotIndexRequest, SnapshotIndexResponse, States, StreamKnnRequest, StreamKnnResponse,
        UpdateRequest, UpdateResponse, VerifyIndexRequest, VerifyIndexResponse, WatchRequest,
        WatchResponse, WriteRequest, WriteResponse,
        index_service_server::{IndexService, IndexServiceServer},
        knn_request, neighbor_spec,
        point_service_server::{PointService, PointServiceServer},
        stream_knn_response::Result as StreamedAnswer,
    },
};

/// The space of the index.
const SPACE: &str = "R3*SO3:0.15";
const UID: &str = "00000000-0000-4000-8000-000000000000";
/// The number of answers by which a stream may be ahead of its reader.
const MAX_QUEUED: usize = 32;
const MAX_MESSAGE_BYTES: usize = 16 << 20;

/// Serves until it is killed. It prints its address as the server does.
///
/// # Panics
/// If it cannot serve.
pub fn main() -> ExitCode {
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    runtime.block_on(async {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        println!(
            "listening on http://{}",
            listener.local_addr().expect("an address")
        );
        let points = PointServiceServer::new(Echo::default());
        let points = points.max_decoding_message_size(MAX_MESSAGE_BYTES);
        let incoming = TcpListenerStream::new(listener);
        let incoming = tokio_stream::StreamExt::map(incoming, |socket| {
            socket.inspect(|socket| socket.set_nodelay(true).expect("a TCP socket"))
        });
        let indices = IndexServiceServer::new(Echo::default());
        let serving = Server::builder().add_service(points).add_service(indices);
        serving
            .serve_with_incoming(incoming)
            .await
            .expect("a server");
    });
    ExitCode::SUCCESS
}

type AnswerCache<By, Answer> = Arc<Mutex<HashMap<By, Answer>>>;

/// The answers by their numbers of rows and of neighbours.
#[derive(Clone, Debug, Default)]
struct Echo {
    neighbors: AnswerCache<(usize, u32), KnnResponse>,
    outcomes: AnswerCache<(usize, Option<u32>), InsertResponse>,
}

impl Echo {
    fn neighbors(&self, request: &KnnRequest) -> KnnResponse {
        let Some(knn_request::KForm::K(k)) = request.k_form else {
            return KnnResponse::default();
        };
        let rows = row_count(request.states.as_ref());
        let mut made = self
            .neighbors
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let answer = made.entry((rows, k)).or_insert_with(|| KnnResponse {
            neighbors: Some(neighbors(rows, k)),
            revision: revision(),
        });
        answer.clone()
    }

    fn outcomes(&self, request: &InsertRequest) -> InsertResponse {
        let rows = row_count(request.states.as_ref());
        let k = match request.neighbor_spec.as_ref().and_then(|spec| spec.k_form) {
            Some(neighbor_spec::KForm::K(k)) => Some(k),
            _ => None,
        };
        let mut made = self.outcomes.lock().unwrap_or_else(PoisonError::into_inner);
        let answer = made.entry((rows, k)).or_insert_with(|| InsertResponse {
            outcomes: vec![Outcome::Inserted.into(); rows],
            ids: (0..rows as u64).collect(),
            neighbors: k.map(|k| neighbors(rows, k)),
            revision: revision(),
        });
        answer.clone()
    }
}

fn row_count(states: Option<&States>) -> usize {
    states.map_or(0, |states| states.row_count as usize)
}

fn revision() -> Option<Revision> {
    Some(Revision {
        uid: UID.into(),
        number: 1_000,
    })
}

fn neighbors(rows: usize, k: u32) -> Neighbors {
    let found = rows * k as usize;
    Neighbors {
        neighbor_counts: vec![k; rows],
        ids: (0..found as u64).collect(),
        distances: vec![0.5; found],
        ..Default::default()
    }
}

type Answer<T> = Result<Response<T>, Status>;

#[tonic::async_trait]
impl PointService for Echo {
    type StreamKnnStream = ReceiverStream<Result<StreamKnnResponse, Status>>;
    type ScanStream = ReceiverStream<Result<ScanResponse, Status>>;
    type WatchStream = ReceiverStream<Result<WatchResponse, Status>>;

    async fn insert(&self, request: Request<InsertRequest>) -> Answer<InsertResponse> {
        Ok(Response::new(self.outcomes(request.get_ref())))
    }

    async fn knn(&self, request: Request<KnnRequest>) -> Answer<KnnResponse> {
        Ok(Response::new(self.neighbors(request.get_ref())))
    }

    async fn stream_knn(
        &self,
        request: Request<Streaming<StreamKnnRequest>>,
    ) -> Answer<Self::StreamKnnStream> {
        let mut requests = request.into_inner();
        let (sender, answers) = mpsc::channel(MAX_QUEUED);
        let echo = self.clone();
        tokio::spawn(async move {
            while let Ok(Some(StreamKnnRequest { knn: Some(request) })) = requests.message().await {
                let answer = StreamKnnResponse {
                    result: Some(StreamedAnswer::Knn(echo.neighbors(&request))),
                };
                if sender.send(Ok(answer)).await.is_err() {
                    break;
                }
            }
        });
        Ok(Response::new(ReceiverStream::new(answers)))
    }

    async fn update(&self, _: Request<UpdateRequest>) -> Answer<UpdateResponse> {
        Err(not_measured())
    }

    async fn remove(&self, _: Request<RemoveRequest>) -> Answer<RemoveResponse> {
        Err(not_measured())
    }

    async fn open_session(&self, _: Request<OpenSessionRequest>) -> Answer<OpenSessionResponse> {
        Err(not_measured())
    }

    async fn write(&self, _: Request<WriteRequest>) -> Answer<WriteResponse> {
        Err(not_measured())
    }

    async fn get(&self, _: Request<GetRequest>) -> Answer<GetResponse> {
        Err(not_measured())
    }

    async fn query(&self, _: Request<QueryRequest>) -> Answer<QueryResponse> {
        Err(not_measured())
    }

    async fn scan(&self, _: Request<ScanRequest>) -> Answer<Self::ScanStream> {
        Err(not_measured())
    }

    async fn watch(&self, _: Request<WatchRequest>) -> Answer<Self::WatchStream> {
        Err(not_measured())
    }
}

#[tonic::async_trait]
impl IndexService for Echo {
    type SnapshotIndexStream = ReceiverStream<Result<SnapshotIndexResponse, Status>>;
    type VerifyIndexStream = ReceiverStream<Result<VerifyIndexResponse, Status>>;

    async fn get_server(&self, _: Request<GetServerRequest>) -> Answer<GetServerResponse> {
        let most = MAX_MESSAGE_BYTES as u64;
        Ok(Response::new(GetServerResponse {
            version: "echo".into(),
            durability: Durability::Memory.into(),
            limits: Some(Limits {
                max_rows_per_call: most,
                max_ids_per_call: most,
                max_k: most,
                max_request_bytes: most,
                max_answer_bytes: most,
                max_payload_bytes: most,
                max_indexes: 1,
                max_reserved_ids: most,
                max_changed_point_bytes: most,
            }),
        }))
    }

    async fn get_index(&self, request: Request<GetIndexRequest>) -> Answer<GetIndexResponse> {
        let space = SPACE.parse().expect("a space");
        let index = Index {
            name: request.into_inner().index_name,
            space: Some(space::to_message(&space)),
            space_text: SPACE.into(),
            revision: revision(),
            // An empty index would get points first.
            point_count: 1,
            ..Default::default()
        };
        Ok(Response::new(GetIndexResponse { index: Some(index) }))
    }

    async fn create_index(&self, _: Request<CreateIndexRequest>) -> Answer<CreateIndexResponse> {
        Err(not_measured())
    }

    async fn list_indexes(&self, _: Request<ListIndexesRequest>) -> Answer<ListIndexesResponse> {
        Err(not_measured())
    }

    async fn delete_index(&self, _: Request<DeleteIndexRequest>) -> Answer<DeleteIndexResponse> {
        Err(not_measured())
    }

    async fn snapshot_index(
        &self,
        _: Request<SnapshotIndexRequest>,
    ) -> Answer<Self::SnapshotIndexStream> {
        Err(not_measured())
    }

    async fn restore_index(
        &self,
        _: Request<Streaming<RestoreIndexRequest>>,
    ) -> Answer<RestoreIndexResponse> {
        Err(not_measured())
    }

    async fn verify_index(
        &self,
        _: Request<VerifyIndexRequest>,
    ) -> Answer<Self::VerifyIndexStream> {
        Err(not_measured())
    }
}

fn not_measured() -> Status {
    Status::unimplemented("the echo answers what is measured")
}
