//! `grpc.health.v1`: NOT_SERVING until the server answers calls, and again once it begins to stop.

use futures_util::{StreamExt, stream, stream::BoxStream};
use tonic::{Request, Response, Status};
use tonic_health::pb::{
    HealthCheckRequest, HealthCheckResponse, health_check_response::ServingStatus,
    health_server::Health,
};
use wayfold_proto::v1::{index_service_server, point_service_server};

use crate::lifecycle::{Phase, PhaseWatch};

/// The names of the health service: the server as a whole and its services, which share one state.
const NAMES: [&str; 3] = [
    "",
    index_service_server::SERVICE_NAME,
    point_service_server::SERVICE_NAME,
];

/// Answers health checks from the server's phase.
#[derive(Debug)]
pub(crate) struct HealthFace(PhaseWatch);

impl HealthFace {
    /// Reports the phases that `phases` sees.
    pub(crate) fn new(phases: PhaseWatch) -> Self {
        Self(phases)
    }
}

#[tonic::async_trait]
impl Health for HealthFace {
    async fn check(
        &self,
        request: Request<HealthCheckRequest>,
    ) -> Result<Response<HealthCheckResponse>, Status> {
        let name = request.into_inner().service;
        if !NAMES.contains(&name.as_str()) {
            return Err(Status::not_found(format!(
                "no service `{name}`; there are {}, {} and the empty name for the whole server",
                NAMES[1], NAMES[2]
            )));
        }
        Ok(Response::new(report(status_in(self.0.current()))))
    }

    type WatchStream = BoxStream<'static, Result<HealthCheckResponse, Status>>;

    /// Ends after the message that the server is stopping; otherwise the shutdown would wait for it. The protocol keeps
    /// the watch of an unknown name open, in case the name becomes known.
    async fn watch(
        &self,
        request: Request<HealthCheckRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        let known = NAMES.contains(&request.get_ref().service.as_str());
        let phases = self.0.clone();
        if !known {
            let unknown = stream::iter([Ok(report(ServingStatus::ServiceUnknown))]);
            let until_stopping = stream::once(phases.stopping()).filter_map(async |()| None);
            return Ok(Response::new(unknown.chain(until_stopping).boxed()));
        }
        let first = phases.current();
        let changes = stream::unfold(first, move |reported| {
            // `reported` is the last phase sent; STOPPING is the last of all.
            let mut phases = phases.clone();
            async move {
                if reported == Phase::Stopping {
                    return None;
                }
                let phase = phases.changed_from(reported).await;
                Some((Ok(report(status_in(phase))), phase))
            }
        });
        let now = stream::iter([Ok(report(status_in(first)))]);
        Ok(Response::new(now.chain(changes).boxed()))
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
    use crate::lifecycle::Lifecycle;

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
        let health = HealthFace::new(lifecycle.watch());
        for (phase, expected) in [
            (Phase::Starting, ServingStatus::NotServing),
            (Phase::Serving, ServingStatus::Serving),
            (Phase::Stopping, ServingStatus::NotServing),
        ] {
            lifecycle.advance(phase);
            for name in ["", "wayfold.v1.IndexService", "wayfold.v1.PointService"] {
                assert_eq!(check(&health, name).await, expected, "{phase:?} {name}");
            }
        }
        let unknown = health.check(request("wayfold.v1.Nothing")).await;
        assert_eq!(unknown.unwrap_err().code(), tonic::Code::NotFound);
    }

    #[tokio::test]
    async fn watch_tells_each_change_and_ends_with_the_server() {
        let lifecycle = Lifecycle::starting();
        let health = HealthFace::new(lifecycle.watch());
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
        let health = HealthFace::new(lifecycle.watch());
        let mut watch = health.watch(request("other")).await.unwrap().into_inner();
        let first = watch.next().await.unwrap().unwrap();
        assert_eq!(first.status(), ServingStatus::ServiceUnknown);
        lifecycle.advance(Phase::Stopping);
        assert!(watch.next().await.is_none());
    }
}
