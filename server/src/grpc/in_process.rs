//! The calls of points without a connection, for the program that measures what authentication and metrics add to them.

use std::path::Path;

use bytes::Bytes;
use http::Request;
use http_body_util::{BodyExt, Full};
use tokio_util::task::TaskTracker;
use tonic::body::Body;
use tower::{Layer, Service as _};

use super::{
    calls::{Callers, Calls, CallsLayer},
    point_service::TolerantPointServer,
    points,
};
use crate::{
    config::Config,
    faces::Shared,
    identity::{Identities, TableError},
    lifecycle::Lifecycle,
    service::Service,
};

/// See the module.
pub struct InProcess {
    calls: Calls<TolerantPointServer>,
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
        let shared = Shared::new(config, service, Identities::open(identities)?);
        let points = points(&config.grpc, &shared, &Lifecycle::starting().watch());
        let layer = CallsLayer::new(&config.grpc, shared, Callers::Clients, TaskTracker::new());
        Ok(Self {
            calls: layer.layer(points),
        })
    }

    /// Makes a call, and returns the bytes of its answer; none if it was refused.
    pub async fn call(&mut self, request: Request<Bytes>) -> Bytes {
        let request = request.map(|message| Body::new(Full::new(message)));
        let response = match self.calls.call(request).await {
            Ok(response) => response,
            Err(never) => match never {},
        };
        let body = response.into_body().collect().await;
        body.map(|body| body.to_bytes()).unwrap_or_default()
    }
}
