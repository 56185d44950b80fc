//! A server from the bound listener to the last accepted call.

mod error;
mod opening;

use std::{
    convert::Infallible,
    net::SocketAddr,
    pin::pin,
    sync::{Arc, OnceLock},
    time::Duration,
};

use futures_util::{FutureExt, future::OptionFuture};
use tokio::{
    net::TcpListener,
    time::{Instant, interval, sleep_until, timeout},
};
use tokio_util::{
    sync::CancellationToken,
    task::{AbortOnDropHandle, TaskTracker},
};
use tracing::{error, info, warn};

use crate::{
    cluster::{self, Cluster, ClusterError},
    config::{ClusterConfig, Config, HttpConfig, OFF, ON},
    exposure::{self, ExposedAddress},
    faces::{Addresses, Shared},
    grpc::{self, Callers, GrpcError, Tls},
    http::{self, Pages, State},
    identity::Identities,
    lifecycle::{Lifecycle, Phase},
    log::SYNCS,
    service::{Owners, Service},
    snapshots::Schedule,
    zenoh::{self, ZenohFace},
};
pub use error::ServerError;
use opening::OpenedStore;

/// A stopping server waits this long for connections without calls to close. A live peer closes at once, after it has
/// read the rest of its last answer. A frozen peer, or one that never spoke, does not close.
const IDLE_WAIT: Duration = Duration::from_secs(5);

/// Aborted connections may take this long to close.
const CUT_WAIT: Duration = Duration::from_secs(1);

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
    let store = OpenedStore::default();
    let ended = serve_from(store.clone(), config, listener, shutdown, ready).await;
    store.close().await;
    ended
}

/// Does the work of [`serve`], which closes the store however this ends.
async fn serve_from(
    store: OpenedStore,
    config: Config,
    listener: TcpListener,
    shutdown: impl Future<Output = ()>,
    ready: impl FnOnce(&Addresses),
) -> Result<(), ServerError> {
    let address = listener.local_addr()?;
    let tls = Tls::open(&config.tls)?;
    let pages = bind_pages(&config.http).await?;
    let pages_at = pages.as_ref().map(TcpListener::local_addr).transpose()?;
    let members = bind_members(&config.cluster).await?;
    let members_at = members.as_ref().map(TcpListener::local_addr).transpose()?;
    let warnings = check_exposure(&config, address, (pages_at, members_at), tls.is_some())?;
    let member_tls = config.cluster.peer_ca().filter(|_| members.is_some());
    let member_tls = member_tls
        .map(|ca| Tls::of_members(&config.tls, ca))
        .transpose()?;
    let own = members_at
        .map(|at| cluster::advertised(&config.cluster, at))
        .transpose()?;
    let identities = Identities::open(config.access.identities())?;
    let (data, min_free_bytes) = (config.data.directory(), config.disk.min_free_bytes);
    let schedule = Schedule::open(&config.snapshot, data, min_free_bytes)?;
    let publishes = !identities.are_required() || config.access.publish_events == ON;
    let durability = config.data.directory().map(|_| config.data.durability);
    let service = Service::starting_durable(config.limits.clone(), durability);
    let lifecycle = Lifecycle::starting();
    let shared = Shared::new(&config, service.clone(), identities);
    let metrics = shared.metrics.clone();
    let following = shared.identities.clone();
    let following = following.follow(metrics.wrong_file("identities"));
    let _following = AbortOnDropHandle::new(tokio::spawn(following));
    let of_clients = tls.clone().map(|tls| (tls, "certificates"));
    let of_members = member_tls.clone().map(|tls| (tls, "peer_certificates"));
    let _renewing = of_clients
        .into_iter()
        .chain(of_members)
        .map(|(tls, file)| {
            AbortOnDropHandle::new(tokio::spawn(tls.follow(metrics.wrong_file(file))))
        })
        .collect::<Vec<_>>();
    let under_way = TaskTracker::new();
    let _reporting = AbortOnDropHandle::new(tokio::spawn(shared.admission.clone().report()));
    let cut = CancellationToken::new();
    let mut shutdown = pin!(shutdown);
    let opening = ZenohFace::open(&config.zenoh, shared.clone(), config.cluster.is_on());
    let mut zenoh = tokio::select! {
        opened = opening => opened?,
        // It may wait for its routers without end.
        () = &mut shutdown => return Ok(()),
    };
    let addresses = Addresses {
        grpc: address,
        pages: pages_at,
        has_tls: tls.is_some(),
        has_identities: shared.identities.are_required(),
        zenoh: match &zenoh {
            Some(face) => face.locators().await,
            None => Vec::new(),
        },
        warnings,
    };
    let _pages = pages.map(|listener| {
        let is_local = pages_at.is_some_and(|at| at.ip().is_loopback());
        // A machine trusts itself: a probe on it needs no certificate.
        let tls = tls.clone().filter(|_| !is_local);
        AbortOnDropHandle::new(tokio::spawn(serve_pages(
            listener,
            tls,
            Pages {
                shared: shared.clone(),
                phases: lifecycle.watch(),
                addresses: Arc::new(addresses.clone()),
                under_way: under_way.clone(),
            },
        )))
    });
    let serve_grpc = |shared, listener| {
        let (under_way, cut) = (under_way.clone(), cut.clone());
        grpc::serve(
            &config.grpc,
            shared,
            lifecycle.watch(),
            listener,
            under_way,
            cut,
        )
    };
    let serving_members = members
        .map(|listener| serve_grpc(shared.clone(), (listener, member_tls, Callers::Members)));
    let serving_clients = serve_grpc(shared, (listener, tls, Callers::Clients));
    let mut serving = pin!(async {
        tokio::try_join!(
            serving_clients,
            OptionFuture::from(serving_members).map(Option::transpose)
        )
        .map(drop)
    });

    // Meanwhile connections are accepted, and calls get UNAVAILABLE.
    let opening = store.open_registry(
        config.index.options(&config.limits),
        (config.data.clone(), config.cluster.options()),
        config.watermarks(),
    );
    let joined = OnceLock::new();
    let live = async {
        let (registry, nats) = opening.await?;
        let registry = Arc::new(registry);
        // The journal gets back the records that it has lost while this server still starts: others may wait for them.
        let maintaining = Arc::clone(&registry).maintain(|| {
            if service.is_serving() {
                lifecycle.advance(Phase::Serving);
            }
        });
        let starting = async {
            registry.catch_up().await;
            service.set_registry(Arc::clone(&registry));
            if let Some((nats, own)) = nats.zip(own) {
                info!(address = ?members_at, advertised = own, "joining the cluster");
                let cluster = Arc::new(Cluster::join(&config.cluster, &config.tls, nats, own));
                service.set_owners(Arc::clone(&cluster) as Arc<dyn Owners>);
                let _ = joined.set(cluster);
            }
            let _of_members = match joined.get() {
                Some(cluster) => Some(cluster.serve(&service).await),
                None => None,
            };
            service.set_ready();
            // If the store cannot be opened, every call fails with the cause.
            if registry.failure().is_none() {
                lifecycle.advance(Phase::Serving);
                info!(%address, "serving");
            }
            if let Some(face) = &mut zenoh {
                face.announce(publishes).await?;
            }
            ready(&addresses);
            let _snapshots = schedule.map(|schedule| {
                AbortOnDropHandle::new(tokio::spawn(schedule.run(service.clone(), metrics)))
            });
            std::future::pending::<Result<Infallible, ServerError>>().await
        };
        tokio::select! {
            failed = starting => failed,
            () = maintaining => Err(ServerError::Ended),
        }
    };
    tokio::select! {
        ended = &mut serving => return ended.map_err(ServerError::from).and(Err(ServerError::Ended)),
        failed = live => match failed? {},
        () = &mut shutdown => {}
    }

    if let Some(cluster) = joined.get() {
        cluster.leave().await;
    }
    // The service refuses new calls first, so that all of them fail once the phase announces the shutdown.
    service.begin_shutdown();
    lifecycle.advance(Phase::Stopping);
    drain(serving, zenoh, under_way, cut, config.shutdown.grace_ms).await
}

/// The listener of the pages for operators, unless they are off.
async fn bind_pages(config: &HttpConfig) -> Result<Option<TcpListener>, ServerError> {
    if config.listen == OFF {
        return Ok(None);
    }
    let bound = TcpListener::bind(&config.listen).await;
    bound.map(Some).map_err(|source| ServerError::Pages {
        listen: config.listen.clone(),
        source,
    })
}

/// The listener for the other members, if the server is in a cluster.
async fn bind_members(config: &ClusterConfig) -> Result<Option<TcpListener>, ClusterError> {
    if !config.is_on() {
        return Ok(None);
    }
    let bound = TcpListener::bind(&config.listen).await;
    bound.map(Some).map_err(|source| ClusterError::Listener {
        listen: config.listen.clone(),
        source,
    })
}

/// Serves the pages for operators.
async fn serve_pages(listener: TcpListener, tls: Option<Tls>, pages: Pages) {
    let metrics = &pages.shared.metrics;
    metrics.add_syncs(SYNCS.clone());
    metrics.add(State {
        shared: pages.shared.clone(),
        phases: pages.phases.clone(),
    });
    if let Err(error) = http::serve(listener, tls, pages).await {
        error!(%error, "the pages for operators are not served any more");
    }
}

/// Refuses to reach beyond this machine without TLS and identities, unless that is allowed. Returns a warning for each
/// address that does.
fn check_exposure(
    config: &Config,
    address: SocketAddr,
    (pages, members): (Option<SocketAddr>, Option<SocketAddr>),
    has_tls: bool,
) -> Result<Vec<String>, ServerError> {
    let mut exposed = zenoh::exposed(&config.zenoh)?;
    let listens = [("grpc.listen", Some(address)), ("http.listen", pages)];
    for (setting, address) in listens {
        if let Some(address) = address.filter(|address| !address.ip().is_loopback()) {
            exposed.push(ExposedAddress {
                address: format!("{setting}: {address}"),
                has_tls,
            });
        }
    }
    let has_identities = config.access.identities().is_some();
    let is_allowed = config.access.insecure == ON;
    let mut warnings = exposure::check(&exposed, has_identities, is_allowed)?;
    if let Some(address) = members {
        let has_certificates = config.cluster.peer_ca().is_some();
        let warning =
            exposure::check_members(address, has_certificates, has_identities, is_allowed)?;
        warnings.extend(warning);
    }
    Ok(warnings)
}

/// Finishes the accepted calls for at most the grace time, then cuts the rest. `serving` ends once gRPC has stopped;
/// `under_way` are the calls of gRPC and of the pages.
async fn drain(
    serving: impl Future<Output = Result<(), GrpcError>>,
    zenoh: Option<ZenohFace>,
    under_way: TaskTracker,
    cut: CancellationToken,
    grace_ms: u64,
) -> Result<(), ServerError> {
    under_way.close();
    let faces: Vec<TaskTracker> = [under_way.clone()]
        .into_iter()
        .chain(zenoh.as_ref().map(ZenohFace::under_way))
        .collect();
    info!(
        calls = in_use(&faces),
        grace_ms, "stopping: finishing accepted calls"
    );
    let grace_end = Instant::now() + Duration::from_millis(grace_ms);
    let zenoh_stopped = async {
        if let Some(face) = zenoh {
            face.stop().await;
        }
    };
    let mut stopped = pin!(async { tokio::join!(serving, zenoh_stopped, under_way.wait()).0 });
    let calls = tokio::select! {
        drained = &mut stopped => {
            info!("stopped");
            return drained.map_err(ServerError::from);
        }
        () = idle(&faces) => 0,
        () = sleep_until(grace_end) => in_use(&faces),
    };
    if calls > 0 {
        warn!(calls, grace_ms, "cutting unfinished calls");
    } else {
        info!("cutting idle connections that do not close");
    }
    cut.cancel();
    // A timeout changes nothing: the outcome is reported below.
    let _ = timeout(CUT_WAIT, stopped).await;
    if calls > 0 {
        return Err(ServerError::Cut { calls, grace_ms });
    }
    info!("stopped");
    Ok(())
}

/// The number of calls in flight over all faces.
fn in_use(faces: &[TaskTracker]) -> usize {
    faces.iter().map(TaskTracker::len).sum()
}

/// Returns once no call has been in flight for [`IDLE_WAIT`].
async fn idle(faces: &[TaskTracker]) {
    let mut ticks = interval(IDLE_WAIT / 10);
    let mut since = Instant::now();
    loop {
        let now = ticks.tick().await;
        if in_use(faces) > 0 {
            since = now;
        } else if now.saturating_duration_since(since) >= IDLE_WAIT {
            return;
        }
    }
}
