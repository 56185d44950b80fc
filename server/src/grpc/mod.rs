//! The gRPC face: translates `wayfold.v1` to calls of the service and holds no policy of its own. The client of the other
//! members of a cluster is here too.

mod backlog;
mod body;
mod calls;
mod connection;
mod connections;
mod deadline;
mod health;
mod in_process;
mod index_service;
mod member_client;
mod member_service;
mod message_reader;
mod point_service;
mod read_queue;
mod refusals;
mod request_body;
mod rpcs;
mod status;
mod stream_knn;
mod tls;

use std::{io, sync::Arc, time::Duration};

use thiserror::Error;
use tokio_util::{
    sync::CancellationToken,
    task::{AbortOnDropHandle, TaskTracker},
};
use tonic::transport::Server;
use tonic_health::pb::health_server::HealthServer;
use wayfold_proto::v1::{self, index_service_server::IndexServiceServer};

use backlog::STREAM_WINDOW;
use calls::CallsLayer;
pub(crate) use calls::{Callers, token};
use connections::Connections;
use health::HealthFace;
pub use in_process::InProcess;
use index_service::IndexFace;
pub(crate) use member_client::MemberClient;
use member_service::MemberFace;
use point_service::TolerantPointServer;
use stream_knn::KnnStreams;
pub use tls::TlsError;
#[cfg(test)]
pub(crate) use tls::testing as tls_testing;
pub(crate) use tls::{Client, FaceListener, Socket, Tls};

use crate::{config::GrpcConfig, faces::FaceContext, lifecycle::PhaseWatch};

/// The gRPC face could not be served.
#[derive(Debug, Error)]
pub enum GrpcError {
    /// A bug: the descriptors that reflection serves do not fit together.
    #[error("the descriptors for gRPC reflection are broken: {0}")]
    Reflection(#[from] tonic_reflection::server::Error),
    /// The transport failed.
    #[error("gRPC transport: {0}")]
    Transport(#[from] tonic::transport::Error),
    /// The listener failed.
    #[error("gRPC listener: {0}")]
    Listener(#[from] io::Error),
}

/// The calls of a connection that may be cancelled before the server looks at them; one more cuts it.
const MAX_PENDING_RESETS: usize = 2_048;

/// The most bytes of a call's headers, as HTTP/2 counts them: the 8 KiB that W3C allows for baggage, and as many for a token.
/// Kept apart, short headers take several times as many.
const MAX_HEADER_BYTES: u32 = 16 * 1024;

/// The largest request for health or reflection. Strangers may send them, and no budget counts their bytes.
const MAX_UNAUTHENTICATED_REQUEST_BYTES: usize = 4 * 1024;

/// The most lasting streams of a connection with `max_calls`: streams must not take the places of calls that end, which
/// would wait in the client without a word.
fn max_streams(max_calls: u32) -> usize {
    (max_calls - max_calls.div_ceil(4)) as usize
}

/// Serves `shared` to `callers` on `listener` until the server begins to stop and every call that was accepted is done.
///
/// `under_way` counts the running calls. `cut` fails the connections that are still open, so that this returns soon.
pub(crate) async fn serve(
    config: &GrpcConfig,
    shared: FaceContext,
    phases: PhaseWatch,
    listener: FaceListener,
    callers: Callers,
    under_way: TaskTracker,
    cut: CancellationToken,
) -> Result<(), GrpcError> {
    let health = HealthServer::new(HealthFace::new(phases.clone(), shared.service.clone()))
        .max_decoding_message_size(MAX_UNAUTHENTICATED_REQUEST_BYTES);
    // Sent messages have no limit: the service refuses a large answer before a mutation takes effect, and a second
    // limit here could only fail a call that took effect.
    let indices = IndexServiceServer::new(IndexFace {
        service: shared.service.clone(),
        max_message_bytes: config.max_message_bytes,
    })
    .max_decoding_message_size(config.max_message_bytes);
    let reflection = descriptors().build_v1()?;
    let reflection = reflection.max_decoding_message_size(MAX_UNAUTHENTICATED_REQUEST_BYTES);
    let reflection_alpha = descriptors().build_v1alpha()?;
    let reflection_alpha =
        reflection_alpha.max_decoding_message_size(MAX_UNAUTHENTICATED_REQUEST_BYTES);
    let keepalive = (config.keepalive_interval_ms > 0)
        .then(|| Duration::from_millis(config.keepalive_interval_ms));
    let max_calls = callers.max_calls(config);
    let connections = Connections::new(
        config.max_connections,
        max_streams(max_calls),
        shared.admission.clone(),
    );
    let send_timeout = Duration::from_millis(config.send_timeout_ms);
    let watched = Arc::clone(&connections);
    let _watching = AbortOnDropHandle::new(tokio::spawn(async move {
        watched.cut_waiting(send_timeout).await;
    }));
    let read_queue = Arc::clone(connections.read_queue());
    let _reading = AbortOnDropHandle::new(tokio::spawn(async move {
        read_queue.give_turns().await;
    }));
    let of_members = (callers == Callers::Members).then(|| MemberFace {
        service: shared.service.clone(),
    });
    Server::builder()
        .max_concurrent_streams(max_calls)
        .initial_stream_window_size(STREAM_WINDOW)
        .http2_max_header_list_size(MAX_HEADER_BYTES)
        // A client that cancels many calls in a row keeps its connection.
        .http2_max_pending_accept_reset_streams(Some(MAX_PENDING_RESETS))
        .http2_keepalive_interval(keepalive)
        .http2_keepalive_timeout(Some(Duration::from_millis(config.keepalive_timeout_ms)))
        .layer(CallsLayer::new(config, shared.clone(), callers, under_way))
        .add_service(indices)
        .add_service(points(config, &shared, &phases))
        .add_optional_service(of_members)
        .add_service(health)
        .add_service(reflection)
        .add_service(reflection_alpha)
        .serve_with_incoming_shutdown(
            connection::incoming(listener, connections, cut),
            phases.stopping(),
        )
        .await?;
    Ok(())
}

/// The service of the points.
fn points(config: &GrpcConfig, shared: &FaceContext, phases: &PhaseWatch) -> TolerantPointServer {
    TolerantPointServer::new(KnnStreams {
        service: shared.service.clone(),
        admission: shared.admission.clone(),
        phases: phases.clone(),
        window: config.stream_window,
        max_message_bytes: config.max_message_bytes,
    })
}

/// The descriptors for reflection, with google.rpc, so that generic clients can print error details.
fn descriptors() -> tonic_reflection::server::Builder<'static> {
    tonic_reflection::server::Builder::configure()
        .register_encoded_file_descriptor_set(v1::FILE_DESCRIPTOR_SET)
        .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
        .register_encoded_file_descriptor_set(tonic_types::pb::FILE_DESCRIPTOR_SET)
}
