//! A server in this process, on a port of its own, and the clients to talk to it.

use std::net::SocketAddr;

use tokio::{net::TcpListener, sync::oneshot, task::JoinHandle};
use tonic::{
    Code, Status,
    transport::{Channel, Endpoint},
};
use tonic_health::pb::{
    HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient,
};
use tonic_types::StatusExt;
use wayfold_proto::v1::{
    self, index_service_client::IndexServiceClient, point_service_client::PointServiceClient,
};
use wayfold_server::{
    ServerError,
    config::{Config, DataConfig, OFF, ZenohConfig},
};

/// A running server.
pub struct TestServer {
    pub address: SocketAddr,
    pub channel: Channel,
    stop: oneshot::Sender<()>,
    ended: JoinHandle<Result<(), ServerError>>,
}

impl TestServer {
    /// Starts a server with the settings that `adapt` makes of the defaults, and waits until it serves.
    pub async fn start(adapt: impl FnOnce(&mut Config)) -> Self {
        Self::start_for(adapt, connect).await
    }

    /// The same, for calls over the channel that `connect` makes.
    pub async fn start_for(
        adapt: impl FnOnce(&mut Config),
        connect: impl AsyncFnOnce(SocketAddr) -> Channel,
    ) -> Self {
        let mut config = Config::default();
        config.data.dir = DataConfig::MEMORY.into();
        config.zenoh.listen = ZenohConfig::OFF.into();
        config.http.listen = OFF.into();
        adapt(&mut config);
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let (stop, stopped) = oneshot::channel();
        let ended = tokio::spawn(wayfold_server::run(config, listener, async {
            let _ = stopped.await;
        }));
        let channel = connect(address).await;
        let server = Self {
            address,
            channel,
            stop,
            ended,
        };
        server.wait_until(ServingStatus::Serving).await;
        server
    }

    pub fn indices(&self) -> IndexServiceClient<Channel> {
        IndexServiceClient::new(self.channel.clone())
    }

    pub fn points(&self) -> PointServiceClient<Channel> {
        PointServiceClient::new(self.channel.clone())
    }

    pub fn health(&self) -> HealthClient<Channel> {
        HealthClient::new(self.channel.clone())
    }

    /// Waits until the health of the server is `status`.
    pub async fn wait_until(&self, status: ServingStatus) {
        let request = HealthCheckRequest::default();
        let mut reports = self.health().watch(request).await.unwrap().into_inner();
        while reports.message().await.unwrap().unwrap().status() != status {}
    }

    /// An index over the real line.
    pub async fn create_line(&self, name: &str) -> v1::Index {
        let created = self.indices().create_index(creation(name, "R1")).await;
        created.unwrap().into_inner().index.unwrap()
    }

    /// An index over the real line with the points 0, 1, …, `count` − 1, each under the id of the same number.
    pub async fn create_ruler(&self, name: &str, count: u64) -> v1::Index {
        let index = self.create_line(name).await;
        let ids: Vec<u64> = (0..count).collect();
        for ids in ids.chunks(50_000) {
            let coordinates: Vec<f64> = ids.iter().map(|id| *id as f64).collect();
            let mut request = insert(name, &coordinates);
            request.ids = ids.to_vec();
            self.points().insert(request).await.unwrap();
        }
        index
    }

    /// Asks the server to stop and does not wait for its end.
    pub fn stop(self) -> JoinHandle<Result<(), ServerError>> {
        self.stop.send(()).unwrap();
        self.ended
    }
}

pub async fn connect(address: SocketAddr) -> Channel {
    let endpoint = Endpoint::from_shared(format!("http://{address}")).unwrap();
    endpoint.connect().await.unwrap()
}

pub fn creation(name: &str, space: &str) -> v1::CreateIndexRequest {
    v1::CreateIndexRequest {
        name: name.into(),
        space_form: Some(v1::create_index_request::SpaceForm::SpaceText(space.into())),
        ..Default::default()
    }
}

pub fn insert(index: &str, coordinates: &[f64]) -> v1::InsertRequest {
    v1::InsertRequest {
        index_name: index.into(),
        states: Some(column(coordinates)),
        ..Default::default()
    }
}

pub fn uid_of(index: &v1::Index) -> String {
    index.revision.clone().unwrap().uid
}

pub fn knn(index: &str, coordinates: &[f64], k: u32) -> v1::KnnRequest {
    v1::KnnRequest {
        index_name: index.into(),
        states: Some(column(coordinates)),
        k_form: Some(v1::knn_request::KForm::K(k)),
        ..Default::default()
    }
}

/// The id of the nearest point of a ruler, whose points are at the whole numbers.
pub fn nearest(answer: v1::StreamKnnResponse) -> u64 {
    match answer.result.unwrap() {
        v1::stream_knn_response::Result::Knn(answer) => answer.neighbors.unwrap().ids[0],
        v1::stream_knn_response::Result::Error(status) => panic!("{status:?}"),
    }
}

pub fn column(coordinates: &[f64]) -> v1::States {
    v1::States {
        row_count: u32::try_from(coordinates.len()).unwrap(),
        coordinates: coordinates.to_vec(),
    }
}

/// The reason in the `ErrorInfo` of a status, after checks of the code and of the domain.
pub fn reason(status: &Status, code: Code) -> String {
    assert_eq!(status.code(), code, "{status:?}");
    let info = status.get_details_error_info().expect("an ErrorInfo");
    assert_eq!(info.domain, "wayfold");
    info.reason
}
