//! A server from the bound listener to the last accepted call.

mod drain;
mod error;
mod listeners;
mod opening;

use std::{
    convert::Infallible,
    future::pending,
    pin::pin,
    sync::{Arc, OnceLock},
};

use futures_util::{FutureExt, future::OptionFuture};
use tokio::net::TcpListener;
use tokio_util::{
    sync::CancellationToken,
    task::{AbortOnDropHandle, TaskTracker},
};
use tracing::{error, info};

use crate::{
    cluster::Cluster,
    config::{Config, ON},
    faces::{Addresses, FaceContext},
    grpc::{self, Callers, FaceListener, GrpcError, Tls},
    http::{self, MetricsCollector, Pages},
    identity::Identities,
    lifecycle::{Lifecycle, Phase},
    log::SYNCS,
    service::{Owners, Service},
    snapshots::Schedule,
    zenoh::{ZenohError, ZenohFace},
};
use drain::drain;
pub use error::ServerError;
use listeners::Listeners;
use opening::StoreLifetime;

/// Serves gRPC on `listener`, and Zenoh as configured, until `shutdown` resolves. Then it finishes the accepted calls
/// and returns.
pub async fn run(
    config: Config,
    listener: TcpListener,
    shutdown: impl Future<Output = ()>,
) -> Result<(), ServerError> {
    serve(config, listener, shutdown, |_| ()).await
}

/// Does the work of [`run`], and calls `ready` with the addresses once the server answers calls.
pub(crate) async fn serve(
    config: Config,
    listener: TcpListener,
    shutdown: impl Future<Output = ()>,
    ready: impl FnOnce(&Addresses),
) -> Result<(), ServerError> {
    let store = StoreLifetime::default();
    let ended = serve_from(store.clone(), config, listener, shutdown, ready).await;
    // A merge of the store's tables that is under way is waited for.
    store.close().await;
    if ended.is_ok() {
        info!("stopped");
    }
    ended
}

/// Does the work of [`serve`], which closes the store however this ends.
async fn serve_from(
    store: StoreLifetime,
    config: Config,
    listener: TcpListener,
    shutdown: impl Future<Output = ()>,
    ready: impl FnOnce(&Addresses),
) -> Result<(), ServerError> {
    let mut listeners = Listeners::bind(&config, listener).await?;
    let server = Server::new(config)?;
    let config = &server.config;
    let schedule = Schedule::open(
        &config.snapshot,
        config.data.directory(),
        config.disk.min_free_bytes,
    )?;
    let _following = server.follow_files(&listeners);
    let _reporting = spawn(server.context.admission.clone().report());
    let mut shutdown = pin!(shutdown);
    let mut zenoh = tokio::select! {
        opened = server.open_zenoh() => opened?,
        // It may wait for its routers without end.
        () = &mut shutdown => return Ok(()),
    };
    if let Some(face) = &zenoh {
        listeners.addresses.zenoh = face.locators().await;
    }
    let addresses = listeners.addresses;
    let serve_pages = |listener| spawn(serve_pages(listener, server.pages(&addresses)));
    let _pages = listeners.pages.map(serve_pages);
    let mut serving = pin!(server.serve_grpc(listeners.clients, listeners.members));
    // Meanwhile connections are accepted, and calls get UNAVAILABLE.
    let live = server.bring_up(
        store,
        listeners.advertised,
        schedule,
        &mut zenoh,
        &addresses,
        ready,
    );
    tokio::select! {
        ended = &mut serving => return ended.map_err(ServerError::from).and(Err(ServerError::Ended)),
        failed = live => match failed? {},
        () = &mut shutdown => {}
    }

    server.begin_shutdown().await;
    let grace_ms = config.shutdown.grace_ms;
    drain(serving, zenoh, &server.under_way, &server.cut, grace_ms).await
}

/// A server, but for its listeners and its store.
struct Server {
    config: Config,
    context: FaceContext,
    lifecycle: Lifecycle,
    /// The cluster, once the server has joined it.
    cluster: OnceLock<Arc<Cluster>>,
    /// The calls of gRPC and of the pages.
    under_way: TaskTracker,
    /// Cuts the connections of gRPC.
    cut: CancellationToken,
}

impl Server {
    /// A server that has opened nothing but the identities.
    fn new(config: Config) -> Result<Self, ServerError> {
        let identities = Identities::open(config.access.identities())?;
        let durability = config.data.directory().map(|_| config.data.durability);
        let service = Service::starting_durable(config.limits.clone(), durability);
        Ok(Self {
            context: FaceContext::new(&config, service, identities),
            config,
            lifecycle: Lifecycle::starting(),
            cluster: OnceLock::new(),
            under_way: TaskTracker::new(),
            cut: CancellationToken::new(),
        })
    }

    /// Reads identities and certificates again whenever their files change, until the result is dropped.
    fn follow_files(&self, listeners: &Listeners) -> Vec<AbortOnDropHandle<()>> {
        let metrics = &self.context.metrics;
        let identities = self.context.identities.clone();
        let identities = spawn(identities.follow(metrics.wrong_file("identities")));
        let members = listeners.members.as_ref();
        let certificates = [
            (listeners.clients.tls.clone(), "certificates"),
            (members.and_then(|it| it.tls.clone()), "peer_certificates"),
        ];
        let follow =
            |(tls, file): (Option<Tls>, _)| Some(spawn(tls?.follow(metrics.wrong_file(file))));
        let certificates = certificates.into_iter().filter_map(follow);
        [identities].into_iter().chain(certificates).collect()
    }

    async fn open_zenoh(&self) -> Result<Option<ZenohFace>, ZenohError> {
        let in_cluster = self.config.cluster.is_on();
        ZenohFace::open(&self.config.zenoh, self.context.clone(), in_cluster).await
    }

    /// The sources of the pages for operators.
    fn pages(&self, addresses: &Addresses) -> Pages {
        Pages {
            shared: self.context.clone(),
            phases: self.lifecycle.watch(),
            addresses: Arc::new(addresses.clone()),
            under_way: self.under_way.clone(),
        }
    }

    /// Serves gRPC to clients, and to the other members of a cluster.
    async fn serve_grpc(
        &self,
        clients: FaceListener,
        members: Option<FaceListener>,
    ) -> Result<(), GrpcError> {
        let serve = |listener, callers| {
            let (context, phases) = (self.context.clone(), self.lifecycle.watch());
            let (under_way, cut) = (self.under_way.clone(), self.cut.clone());
            grpc::serve(
                &self.config.grpc,
                context,
                phases,
                listener,
                callers,
                under_way,
                cut,
            )
        };
        let members = OptionFuture::from(members.map(|listener| serve(listener, Callers::Members)));
        tokio::try_join!(
            serve(clients, Callers::Clients),
            members.map(Option::transpose)
        )
        .map(drop)
    }

    /// Opens the store, joins the cluster if there is one, and calls `ready` once calls are answered. Then it maintains the
    /// store and takes snapshots, until it is dropped or fails.
    async fn bring_up(
        &self,
        store: StoreLifetime,
        advertised: Option<String>,
        schedule: Option<Schedule>,
        zenoh: &mut Option<ZenohFace>,
        addresses: &Addresses,
        ready: impl FnOnce(&Addresses),
    ) -> Result<Infallible, ServerError> {
        let (config, service) = (&self.config, &self.context.service);
        let opening = store.open_registry(
            config.index.options(&config.limits),
            config.data.clone(),
            config.cluster.options(),
            config.watermarks(),
        );
        let (registry, nats) = opening.await?;
        let registry = Arc::new(registry);
        // The journal gets back the records that it has lost while this server still starts: others may wait for them.
        let maintaining = Arc::clone(&registry).maintain(|| {
            if service.is_serving() {
                self.lifecycle.advance(Phase::Serving);
            }
        });
        let starting = async {
            registry.catch_up().await;
            service.set_registry(Arc::clone(&registry));
            if let Some((nats, own)) = nats.zip(advertised) {
                info!(address = ?addresses.members, advertised = own, "joining the cluster");
                let cluster = Arc::new(Cluster::join(&config.cluster, &config.tls, nats, own));
                service.set_owners(Arc::clone(&cluster) as Arc<dyn Owners>);
                let _ = self.cluster.set(cluster);
            }
            let _of_members = match self.cluster.get() {
                Some(cluster) => Some(cluster.serve(service).await),
                None => None,
            };
            service.set_ready();
            // If the store cannot be opened, every call fails with the cause.
            if registry.failure().is_none() {
                self.lifecycle.advance(Phase::Serving);
                info!(address = %addresses.grpc, "serving");
            }
            if let Some(face) = zenoh {
                let is_open = !self.context.identities.are_required();
                let publishes = is_open || config.access.publish_events == ON;
                face.announce(publishes).await?;
            }
            ready(addresses);
            let metrics = self.context.metrics.clone();
            let _snapshots = schedule.map(|schedule| spawn(schedule.run(service.clone(), metrics)));
            pending::<Result<Infallible, ServerError>>().await
        };
        tokio::select! {
            failed = starting => failed,
            () = maintaining => Err(ServerError::Ended),
            () = registry.keep_fitness() => Err(ServerError::Ended),
        }
    }

    /// Leaves the cluster and refuses new calls.
    async fn begin_shutdown(&self) {
        if let Some(cluster) = self.cluster.get() {
            cluster.leave().await;
        }
        // The service refuses new calls first, so that all of them fail once the phase announces the shutdown.
        self.context.service.begin_shutdown();
        self.lifecycle.advance(Phase::Stopping);
    }
}

/// Runs a task until the result is dropped.
fn spawn(task: impl Future<Output = ()> + Send + 'static) -> AbortOnDropHandle<()> {
    AbortOnDropHandle::new(tokio::spawn(task))
}

/// Serves the pages for operators.
async fn serve_pages(listener: FaceListener, pages: Pages) {
    let metrics = &pages.shared.metrics;
    metrics.add_syncs(SYNCS.clone());
    metrics.add(MetricsCollector {
        shared: pages.shared.clone(),
        phases: pages.phases.clone(),
    });
    if let Err(error) = http::serve(listener, pages).await {
        error!(%error, "the pages for operators are not served any more");
    }
}
