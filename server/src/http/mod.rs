//! The listener for operators: the page to look at, `/metrics`, and the probes `/healthz` and `/readyz`.
//!
//! Probes and the files of the page answer everyone. Everything else needs an identity where the server has identities: a
//! bearer token, or a client certificate of the connection. `api`, `points` and `overview` are what the page reads; `guard`
//! keeps pages of others away from them.

mod api;
mod bounded;
mod collector;
mod frame;
mod guard;
mod overview;
mod page;
mod points;
mod streams;

use std::{
    future::pending,
    io,
    net::SocketAddr,
    sync::Arc,
    time::{Duration, Instant},
};

use axum::{
    Router,
    extract::{
        State,
        connect_info::{ConnectInfo, Connected},
    },
    http::{StatusCode, header, request::Parts},
    middleware::from_fn_with_state,
    response::{IntoResponse, Response},
    routing::{get, post},
    serve::{IncomingStream, Listener},
};
use tokio::time::timeout;
use tokio_util::task::{TaskTracker, task_tracker::TaskTrackerToken};

use crate::{
    admission::CALL_BYTES,
    faces::{Addresses, FaceContext},
    grpc::{Client, FaceListener, Tls, token},
    identity::Identities,
    lifecycle::{Phase, PhaseWatch},
    observe::{CallRecord, Ending, MAX_SCRAPES},
    service::{Call, Error, Peer, Service},
    status,
};
use api::{Api, refusal, unread};
use bounded::{BoundedConnection, ConnectionSlots};
pub(crate) use collector::MetricsCollector;
use guard::Guard;

/// The media type of OpenMetrics.
const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// The most connections at a time.
pub(crate) const MAX_CONNECTIONS: usize = 256;

/// The pause after a failure of the listener.
const ACCEPT_RETRY_PAUSE: Duration = Duration::from_secs(1);

/// The sources of the pages.
#[derive(Clone)]
pub(crate) struct Pages {
    pub(crate) shared: FaceContext,
    pub(crate) phases: PhaseWatch,
    pub(crate) addresses: Arc<Addresses>,
    /// The calls that a stopping server finishes.
    pub(crate) under_way: TaskTracker,
}

/// Serves the pages on `listener` until it is dropped.
pub(crate) async fn serve(listener: FaceListener, pages: Pages) -> io::Result<()> {
    let routes = routes(pages, listener.tls.is_some());
    let listener = PagesListener {
        listener,
        slots: ConnectionSlots::new(MAX_CONNECTIONS),
    };
    let routes = routes.into_make_service_with_connect_info::<Connection>();
    axum::serve(listener, routes).await
}

/// The other end of a connection, and the certificate of the client once it has shown one.
#[derive(Clone, Debug)]
struct Connection {
    peer: SocketAddr,
    client: Client,
    /// The admitted calls and their unread answers, which keep it open.
    calls: TaskTracker,
}

impl Connected<IncomingStream<'_, PagesListener>> for Connection {
    fn connect_info(connection: IncomingStream<'_, PagesListener>) -> Self {
        connection.remote_addr().clone()
    }
}

/// The context of the call that a request makes, without a deadline.
fn call(identities: &Identities, request: &Parts) -> Call {
    let connection = request.extensions.get::<ConnectInfo<Connection>>();
    let certificate = connection.and_then(|it| it.0.client.get());
    let trace = request.headers.get("traceparent");
    Call {
        caller: identities.caller(token(&request.headers), certificate),
        peer: connection.map(|it| Peer::Address(it.0.peer)),
        trace: trace.and_then(|it| it.to_str().ok()).map(Arc::from),
        ..Call::default()
    }
}

fn routes(pages: Pages, has_tls: bool) -> Router {
    let guard = Guard { has_tls };
    let state = Arc::new(Api::new(&pages, has_tls));
    let api = Router::new()
        .route("/api/v1/addresses", post(overview::addresses))
        .route("/api/v1/overview", post(overview::overview))
        .route("/api/v1/{verb}", post(api::answer))
        .route("/api/v1/{index}/{verb}", post(api::answer))
        // Not by GET: browsers name the origin of every POST, and of some GETs they do not.
        .route("/api/v1/{index}/points", post(points::points))
        .layer(from_fn_with_state(guard, guard::own_origin))
        .route("/metrics", get(metrics))
        .with_state(state);
    Router::new()
        .route("/healthz", get(async || "alive\n"))
        .route("/readyz", get(ready))
        .with_state(Arc::new(pages))
        .merge(api)
        .merge(page::routes())
}

/// Keeps the connection of a request open, so that it makes no room for another.
fn active(request: &Parts) -> Option<TaskTrackerToken> {
    let connection = request.extensions.get::<ConnectInfo<Connection>>();
    connection.map(|it| it.0.calls.token())
}

async fn metrics(State(api): State<Arc<Api>>, request: Parts) -> Response {
    let arrived = Instant::now();
    let shared = &api.shared;
    let call = call(&shared.identities, &request);
    if let Err(denied) = Service::authorize_metrics(&call) {
        let status = status::from_error(&denied);
        // Each look would be a call; only those of strangers count.
        let metrics = &shared.metrics;
        let mut record =
            CallRecord::begin("Http/metrics", "http", "metrics", arrived, metrics, &call);
        record.end(Ending::Failed(status.code));
        return refusal(&status);
    }
    let active = Vec::from_iter(active(&request));
    let held = Arc::new(api.scrapes.hold());
    if !held.take(CALL_BYTES) {
        return refusal(&status::too_many_bytes(api.scrapes.max_bytes()));
    }
    let Some(_place) = shared.metrics.place() else {
        shared.admission.count_excess();
        let status = status::too_many_calls("scrapes", MAX_SCRAPES, "try again later");
        return refusal(&status);
    };
    match metrics_text(shared).await {
        Ok(text) => {
            let text = unread(text.into_bytes(), held, active);
            ([(header::CONTENT_TYPE, OPEN_METRICS)], text).into_response()
        }
        Err(error) => refusal(&status::from_error(&error)),
    }
}

/// The metrics as text.
async fn metrics_text(shared: &FaceContext) -> Result<String, Error> {
    let text = shared.metrics.scrape().await;
    text.map_err(|error| Error::Internal {
        what: format!("the metrics cannot be written: {error}"),
    })
}

/// 200 while calls that read are answered; the text tells whether points can be added too, and whether an index is damaged.
async fn ready(State(pages): State<Arc<Pages>>) -> (StatusCode, &'static str) {
    let service = &pages.shared.service;
    match pages.phases.current() {
        Phase::Serving if !service.accepts_reads() => (
            StatusCode::SERVICE_UNAVAILABLE,
            "the store cannot be read, see `wayfold list`\n",
        ),
        Phase::Serving if !service.accepts_growth() => (StatusCode::OK, "degraded: reading only\n"),
        Phase::Serving if service.has_damage_cached() => (
            StatusCode::OK,
            "degraded: an index is damaged, see `wayfold list`\n",
        ),
        Phase::Serving => (StatusCode::OK, "reading, writing\n"),
        Phase::Starting => (StatusCode::SERVICE_UNAVAILABLE, "starting\n"),
        Phase::Stopping => (StatusCode::SERVICE_UNAVAILABLE, "stopping\n"),
    }
}

/// A listener that bounds its connections.
struct PagesListener {
    listener: FaceListener,
    slots: Arc<ConnectionSlots>,
}

impl Listener for PagesListener {
    type Io = BoundedConnection;
    type Addr = Connection;

    async fn accept(&mut self) -> (Self::Io, Self::Addr) {
        loop {
            let Ok((socket, peer)) = self.listener.socket.accept().await else {
                // The listener fails while the process has no file descriptors left.
                let _ = timeout(ACCEPT_RETRY_PAUSE, pending::<()>()).await;
                continue;
            };
            let slot = self.slots.take().await;
            let calls = slot.calls.clone();
            let client = Client::default();
            let socket = Tls::accept(self.listener.tls.as_ref(), socket, Arc::clone(&client));
            return (
                BoundedConnection::new(socket, slot),
                Connection {
                    peer,
                    client,
                    calls,
                },
            );
        }
    }

    fn local_addr(&self) -> io::Result<Self::Addr> {
        // The listener itself has no client.
        Ok(Connection {
            peer: self.listener.socket.local_addr()?,
            client: Client::default(),
            calls: TaskTracker::new(),
        })
    }
}

#[cfg(test)]
mod tests;
