//! `grpc.health.v1`: NOT_SERVING until the server answers calls, and again once it begins to stop. The name
//! `wayfold.writing` is NOT_SERVING while points cannot be added, and `wayfold.indices` while an index is damaged; the
//! others are not affected by that, but are NOT_SERVING too once the store cannot be read.

use std::time::Duration;

use futures_util::{Stream, StreamExt, stream, stream::BoxStream};
use tokio::time::{Interval, interval};
use tonic::{Request, Response, Status};
use tonic_health::pb::{
    HealthCheckRequest, HealthCheckResponse, health_check_response::ServingStatus,
    health_server::Health,
};
use wayfold_proto::v1::{index_service_server, point_service_server};

use crate::{
    lifecycle::{Phase, PhaseWatch},
    service::Service,
};

/// The names of the health service that share one state: the server as a whole, its services, and reads.
const NAMES: [&str; 4] = [
    "",
    "wayfold.reading",
    index_service_server::SERVICE_NAME,
    point_service_server::SERVICE_NAME,
];

/// The name of a state of its own: NOT_SERVING too while points cannot be added.
const WRITING: &str = "wayfold.writing";

/// The name of a state of its own: NOT_SERVING too while an index is damaged.
const INDICES: &str = "wayfold.indices";

/// The interval at which a watch checks the status.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// Answers health checks from the server's phase and its indices.
pub(crate) struct HealthFace {
    phases: PhaseWatch,
    service: Service,
}

impl HealthFace {
    /// Reports the phases that `phases` sees, and the state of `service`.
    pub(crate) fn new(phases: PhaseWatch, service: Service) -> Self {
        Self { phases, service }
    }

    /// The status under a name; None for an unknown one.
    fn status(&self, name: &str) -> Option<ServingStatus> {
        let phase = status_in(self.phases.current());
        match name {
            WRITING if !self.service.accepts_growth() => Some(ServingStatus::NotServing),
            INDICES if self.service.has_damage_cached() => Some(ServingStatus::NotServing),
            WRITING | INDICES => Some(phase),
            _ if !NAMES.contains(&name) => None,
            _ if !self.service.accepts_reads() => Some(ServingStatus::NotServing),
            _ => Some(phase),
        }
    }

    /// The status under a known name at each change of it or of the phase, until the server begins to stop.
    fn watch_known(&self, name: String) -> impl Stream<Item = ServingStatus> + Send + use<> {
        let watch = StatusWatch {
            health: Self::new(self.phases.clone(), self.service.clone()),
            name,
            ticks: interval(CHECK_INTERVAL),
            reported: None,
        };
        stream::unfold(watch, StatusWatch::next)
    }
}

/// A watch of the status under a known name.
struct StatusWatch {
    health: HealthFace,
    name: String,
    ticks: Interval,
    reported: Option<(Phase, ServingStatus)>,
}

impl StatusWatch {
    /// The next status, and the watch that goes on; none after that of a stopping server.
    async fn next(mut self) -> Option<(ServingStatus, Self)> {
        loop {
            let phase = self.health.phases.current();
            let status = self.health.status(&self.name)?;
            match self.reported {
                Some((Phase::Stopping, _)) => return None,
                Some(reported) if reported == (phase, status) => {}
                _ => {
                    self.reported = Some((phase, status));
                    return Some((status, self));
                }
            }
            tokio::select! {
                _ = self.health.phases.changed_from(phase) => {}
                _ = self.ticks.tick() => {}
            }
        }
    }
}

#[tonic::async_trait]
impl Health for HealthFace {
    async fn check(
        &self,
        request: Request<HealthCheckRequest>,
    ) -> Result<Response<HealthCheckResponse>, Status> {
        let name = request.into_inner().service;
        let unknown = || {
            Status::not_found(format!(
                "no service `{name}`; there are {}, {WRITING}, {INDICES} and the empty name for the whole server",
                NAMES[1..].join(", ")
            ))
        };
        self.status(&name)
            .map(report)
            .map(Response::new)
            .ok_or_else(unknown)
    }

    type WatchStream = BoxStream<'static, Result<HealthCheckResponse, Status>>;

    /// Ends after the message that the server is stopping; otherwise the shutdown would wait for it. The protocol keeps
    /// the watch of an unknown name open, in case the name becomes known.
    async fn watch(
        &self,
        request: Request<HealthCheckRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        let name = &request.get_ref().service;
        if self.status(name).is_some() {
            let reports = self.watch_known(name.clone());
            return Ok(Response::new(reports.map(|it| Ok(report(it))).boxed()));
        }
        let unknown = stream::iter([Ok(report(ServingStatus::ServiceUnknown))]);
        let until_stopping = stream::once(self.phases.clone().stopping());
        let until_stopping = until_stopping.filter_map(async |()| None);
        Ok(Response::new(unknown.chain(until_stopping).boxed()))
    }
}

fn status_in(phase: Phase) -> ServingStatus {
    match phase {
        Phase::Serving => ServingStatus::Serving,
        Phase::Starting | Phase::Stopping => ServingStatus::NotServing,
    }
}

fn report(status: ServingStatus) -> HealthCheckResponse {
    HealthCheckResponse {
        status: status.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::{
        fs,
        sync::{
            Arc,
            atomic::{AtomicU64, Ordering::SeqCst},
        },
    };

    use crate::{
        lifecycle::Lifecycle,
        log::{Catalogue, Durability, FjallLog, Log, MemoryLog, PointStore},
        registry::{Registry, RegistryOptions},
        service::{Call, Limits},
        testing::arm,
        watermark::{Resource, Usage, Watermark, Watermarks},
    };

    fn request(service: &str) -> Request<HealthCheckRequest> {
        Request::new(HealthCheckRequest {
            service: service.to_owned(),
        })
    }

    async fn check(health: &HealthFace, service: &str) -> ServingStatus {
        let response = health.check(request(service)).await.unwrap();
        response.into_inner().status()
    }

    #[tokio::test]
    async fn check_follows_the_phases_under_every_name() {
        let lifecycle = Lifecycle::starting();
        let health = HealthFace::new(lifecycle.watch(), Service::starting(Limits::default()));
        for (phase, expected) in [
            (Phase::Starting, ServingStatus::NotServing),
            (Phase::Serving, ServingStatus::Serving),
            (Phase::Stopping, ServingStatus::NotServing),
        ] {
            lifecycle.advance(phase);
            for name in NAMES {
                assert_eq!(check(&health, name).await, expected, "{phase:?} {name}");
            }
        }
        let unknown = health.check(request("wayfold.v1.Nothing")).await;
        assert_eq!(unknown.unwrap_err().code(), tonic::Code::NotFound);
    }

    #[tokio::test]
    async fn watch_tells_each_change_and_ends_with_the_server() {
        let lifecycle = Lifecycle::starting();
        let health = HealthFace::new(lifecycle.watch(), Service::starting(Limits::default()));
        let mut watch = health.watch(request("")).await.unwrap().into_inner();
        let mut reported = Vec::new();
        for phase in [Phase::Serving, Phase::Stopping] {
            reported.push(watch.next().await.unwrap().unwrap().status());
            lifecycle.advance(phase);
        }
        while let Some(report) = watch.next().await {
            reported.push(report.unwrap().status());
        }
        assert_eq!(
            reported,
            [
                ServingStatus::NotServing,
                ServingStatus::Serving,
                ServingStatus::NotServing
            ]
        );
    }

    #[tokio::test]
    async fn watch_of_an_unknown_name_says_so_and_ends_with_the_server() {
        let lifecycle = Lifecycle::starting();
        let health = HealthFace::new(lifecycle.watch(), Service::starting(Limits::default()));
        let mut watch = health.watch(request("other")).await.unwrap().into_inner();
        let first = watch.next().await.unwrap().unwrap();
        assert_eq!(first.status(), ServingStatus::ServiceUnknown);
        let unknown = health.check(request("other")).await.unwrap_err();
        for name in NAMES.into_iter().chain([WRITING, INDICES]) {
            assert!(unknown.message().contains(name), "{unknown}");
        }
        lifecycle.advance(Phase::Stopping);
        assert!(watch.next().await.is_none());
    }

    #[tokio::test(start_paused = true)]
    async fn writing_is_told_apart_from_serving() {
        let used = Arc::new(AtomicU64::new(0));
        let probed = Arc::clone(&used);
        let memory = Watermark::new(Resource::Memory, move || {
            Ok(Usage {
                used: probed.load(SeqCst),
                high: 85,
                low: 80,
                limit: 100,
            })
        });
        let watermarks = Watermarks {
            memory: Some(Arc::new(memory.measured_every(Duration::ZERO))),
            disk: None,
        };
        let log = Log::from(Arc::new(MemoryLog::new()));
        let registry = Registry::with_watermarks(log, RegistryOptions::default(), watermarks);
        let service = Service::new(registry, Limits::default());
        service.set_ready();
        let lifecycle = Lifecycle::starting();
        lifecycle.advance(Phase::Serving);
        let health = HealthFace::new(lifecycle.watch(), service);
        let mut watch = health.watch(request(WRITING)).await.unwrap().into_inner();
        let (up, down) = (ServingStatus::Serving, ServingStatus::NotServing);
        // The use in percent; at 82 it depends on where it comes from.
        for (percent, expected) in [(0, up), (90, down), (82, down), (79, up), (82, up)] {
            used.store(percent, SeqCst);
            assert_eq!(check(&health, WRITING).await, expected, "{percent}");
            assert_eq!(check(&health, "").await, up);
            if percent != 82 {
                assert_eq!(watch.next().await.unwrap().unwrap().status(), expected);
            }
        }
        lifecycle.advance(Phase::Stopping);
        assert_eq!(watch.next().await.unwrap().unwrap().status(), down);
        assert!(watch.next().await.is_none());
    }

    /// The catalogue names an index without points.
    #[tokio::test(start_paused = true)]
    async fn a_damaged_index_is_told_apart_from_serving() {
        let catalogue = Arc::new(MemoryLog::new());
        catalogue.create(arm()).unwrap();
        let log = Log {
            catalogue,
            ..Log::from(Arc::new(MemoryLog::new()))
        };
        let registry = Registry::new(log, RegistryOptions::default());
        registry.replay().unwrap();
        let service = Service::new(registry, Limits::default());
        service.set_ready();
        let lifecycle = Lifecycle::starting();
        lifecycle.advance(Phase::Serving);
        let health = HealthFace::new(lifecycle.watch(), service.clone());
        let mut watch = health.watch(request(INDICES)).await.unwrap().into_inner();
        let (up, down) = (ServingStatus::Serving, ServingStatus::NotServing);
        assert_eq!(watch.next().await.unwrap().unwrap().status(), down);
        assert_eq!(check(&health, INDICES).await, down);
        for name in NAMES.into_iter().chain([WRITING]) {
            assert_eq!(check(&health, name).await, up, "{name}");
        }
        let request = wayfold_proto::v1::DeleteIndexRequest {
            index_name: "arm".into(),
            ..Default::default()
        };
        let call = Call::default();
        service.delete_index(&call, request).await.unwrap();
        assert_eq!(watch.next().await.unwrap().unwrap().status(), up);
        assert_eq!(check(&health, INDICES).await, up);
    }

    /// The files of the store were lost.
    #[tokio::test(start_paused = true)]
    async fn a_store_that_cannot_be_read_is_not_serving() {
        let directory = tempfile::tempdir().unwrap();
        let store = directory.path().join("store");
        let away = directory.path().join("away");
        let open = || FjallLog::open(directory.path(), Durability::Fsync).unwrap();
        open().create(arm()).unwrap();
        fs::rename(&store, &away).unwrap();
        let log = Arc::new(open());
        let registry = Registry::new(Arc::clone(&log), RegistryOptions::default());
        let service = Service::new(registry, Limits::default());
        service.set_ready();
        let lifecycle = Lifecycle::starting();
        lifecycle.advance(Phase::Serving);
        let health = HealthFace::new(lifecycle.watch(), service);
        let mut watch = health.watch(request("")).await.unwrap().into_inner();
        for expected in [ServingStatus::NotServing, ServingStatus::Serving] {
            for name in NAMES {
                assert_eq!(check(&health, name).await, expected, "{name}");
            }
            assert_eq!(watch.next().await.unwrap().unwrap().status(), expected);
            if store.exists() {
                break;
            }
            fs::rename(&away, &store).unwrap();
            log.reopen().unwrap();
        }
    }
}
