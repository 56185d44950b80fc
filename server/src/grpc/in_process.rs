//! The calls of points without a connection, for the program that measures what admission, authentication and metrics add to
//! them.

use std::{path::Path, sync::Arc};

use bytes::Bytes;
use http::Request;
use http_body_util::{BodyExt, Full};
use tokio_util::task::TaskTracker;
use tonic::{Status, body::Body};
use tower::{Layer, Service as _};

use super::{
    calls::{Callers, Calls, CallsLayer},
    point_service::TolerantPointServer,
    points,
};
use crate::{
    admission::{CALL_BYTES, Flow},
    config::Config,
    faces::FaceContext,
    identity::{Identities, TableError},
    lifecycle::Lifecycle,
    service::Service,
};

/// See the module.
pub struct InProcess {
    calls: Calls<TolerantPointServer>,
    flow: Arc<Flow>,
    /// Streams end when it is dropped.
    _lifecycle: Lifecycle,
}

impl InProcess {
    /// Calls of `service` by the identities in a file, or by everyone. They are counted if `http.listen` is set.
    ///
    /// # Errors
    /// If the file cannot be read or is wrong.
    pub fn new(
        config: &Config,
        service: Service,
        identities: Option<&Path>,
    ) -> Result<Self, TableError> {
        let shared = FaceContext::new(config, service, Identities::open(identities)?);
        let lifecycle = Lifecycle::starting();
        let flow = shared.admission.open();
        let points = points(&config.grpc, &shared, &lifecycle.watch());
        let layer = CallsLayer::new(&config.grpc, shared, Callers::Clients, TaskTracker::new());
        Ok(Self {
            calls: layer.layer(points),
            flow,
            _lifecycle: lifecycle,
        })
    }

    /// Admits a call of a connection that does nothing; false if it is refused.
    pub async fn admit(&self) -> bool {
        let mut turns = self.flow.turns();
        let held = self.flow.hold();
        let is_requested = turns.request().is_ok() && held.take(CALL_BYTES);
        is_requested && turns.run(async {}).await.is_ok()
    }

    /// Makes a call, and returns the bytes of its answer and its status.
    pub async fn call(&mut self, request: Request<Bytes>) -> (Bytes, Status) {
        let request = request.map(|message| Body::new(Full::new(message)));
        let response = match self.calls.call(request).await {
            Ok(response) => response,
            Err(never) => match never {},
        };
        let (head, body) = response.into_parts();
        let body = match body.collect().await {
            Ok(body) => body,
            Err(status) => return (Bytes::new(), status),
        };
        // The headers of a refusal have the status; otherwise the trailers do.
        let status = Status::from_header_map(&head.headers)
            .or_else(|| body.trailers().and_then(Status::from_header_map))
            .unwrap_or_else(|| Status::unknown("an answer without a status"));
        (body.to_bytes(), status)
    }
}
