//! The life of a server: from a bound listener to the last accepted call.

use std::{convert::Infallible, io, net::SocketAddr, pin::pin, sync::Arc, time::Duration};

use thiserror::Error;
use tokio::{
    net::TcpListener,
    time::{Instant, interval, sleep_until, timeout},
};
use tokio_util::sync::CancellationToken;
use tracing::{info, warn};

use crate::{
    capacity::Capacity,
    config::{Config, DataConfig},
    grpc::{self, GrpcError},
    lifecycle::{Lifecycle, Phase},
    log::{FjallLog, Log, MemoryLog, OpenError},
    registry::{Registry, RegistryError, RegistryOptions},
    service::Service,
    zenoh::{ZenohError, ZenohFace},
};

/// How long connections without calls are waited for once the server stops. A peer that lives says goodbye at once,
/// and takes what is left of its last answer; one that is frozen, or never spoke, does neither.
const QUIET_WAIT: Duration = Duration::from_secs(5);

/// How long connections that were cut may take to notice.
const CUT_WAIT: Duration = Duration::from_secs(1);

/// Why a server ended otherwise than well.
#[derive(Debug, Error)]
pub enum ServerError {
    /// The listener is not usable.
    #[error("the listener is not usable: {0}")]
    Listener(#[from] io::Error),
    /// gRPC could not be served.
    #[error(transparent)]
    Grpc(#[from] GrpcError),
    /// Zenoh could not be served.
    #[error(transparent)]
    Zenoh(#[from] ZenohError),
    /// The data directory could not be opened.
    #[error(transparent)]
    Data(#[from] OpenError),
    /// The log holds something that cannot be replayed.
    #[error("cannot replay the log: {0}")]
    Replay(#[from] RegistryError),
    /// Serving ended although nobody asked for it.
    #[error("serving ended by itself; this is a bug")]
    Ended,
    /// The server stopped, but not all calls were done when its time was up. Connections that were cut without a call
    /// do not count.
    #[error(
        "{calls} calls were cut: they were not done {grace_ms} ms after the server began to stop (shutdown.grace_ms)"
    )]
    Cut {
        /// How many.
        calls: usize,
        /// How long they had.
        grace_ms: u64,
    },
}

/// Where a server listens.
pub(crate) struct Addresses {
    pub(crate) grpc: SocketAddr,
    /// Zenoh's locators; none if it is off.
    pub(crate) zenoh: Vec<String>,
}

/// Serves on `listener`, and over Zenoh as the settings say, until `shutdown` ends, finishes what was accepted, and returns.
pub async fn run(
    config: Config,
    listener: TcpListener,
    shutdown: impl Future<Output = ()>,
) -> Result<(), ServerError> {
    serve(config, listener, shutdown, |_| ()).await
}

/// As [`run`], and calls `ready` with the addresses once calls are answered.
pub(crate) async fn serve(
    config: Config,
    listener: TcpListener,
    shutdown: impl Future<Output = ()>,
    ready: impl FnOnce(&Addresses),
) -> Result<(), ServerError> {
    let address = listener.local_addr()?;
    if !address.ip().is_loopback() {
        warn!(
            %address,
            "listening beyond this machine: there is no authentication and no encryption yet, \
             whoever reaches this address can read and change every index"
        );
    }
    let durability = config.data.directory().map(|_| config.data.durability);
    let service = Service::starting_durable(config.limits.clone(), durability);
    let lifecycle = Lifecycle::starting();
    let capacity = Capacity::new(config.grpc.max_calls);
    let cut = CancellationToken::new();
    let mut zenoh = ZenohFace::open(&config.zenoh, service.clone()).await?;
    let addresses = Addresses {
        grpc: address,
        zenoh: match &zenoh {
            Some(face) => face.locators().await,
            None => Vec::new(),
        },
    };
    let mut serving = pin!(grpc::serve(
        &config.grpc,
        service.clone(),
        lifecycle.watch(),
        listener,
        capacity.clone(),
        cut.clone(),
    ));

    // Connections are accepted meanwhile, and calls told to come again.
    let replayed = replayed(config.index.options(), config.data);
    let live = async {
        let registry = Arc::new(replayed.await?);
        service.set_registry(Arc::clone(&registry));
        service.set_ready();
        // With a store that cannot be opened no index is served; why, is told to every call.
        if registry.failure().is_none() {
            lifecycle.advance(Phase::Serving);
            info!(%address, "serving");
        }
        if let Some(face) = &mut zenoh {
            face.announce();
        }
        ready(&addresses);
        registry
            .look_after(|| lifecycle.advance(Phase::Serving))
            .await;
        std::future::pending::<Result<Infallible, ServerError>>().await
    };
    tokio::select! {
        ended = &mut serving => return ended.map_err(ServerError::from).and(Err(ServerError::Ended)),
        failed = live => match failed? {},
        () = shutdown => {}
    }

    // In this order, so that whoever has been told that the server stops can count on it.
    service.begin_shutdown();
    lifecycle.advance(Phase::Stopping);
    let grace_ms = config.shutdown.grace_ms;
    let faces: Vec<Capacity> = [capacity]
        .into_iter()
        .chain(zenoh.as_ref().map(ZenohFace::capacity))
        .collect();
    info!(
        calls = in_use(&faces),
        grace_ms, "stopping: finishing what was accepted"
    );
    let grace_end = Instant::now() + Duration::from_millis(grace_ms);
    let zenoh_stopped = async {
        if let Some(face) = zenoh {
            face.stop().await;
        }
    };
    let mut stopped = pin!(async { tokio::join!(serving, zenoh_stopped).0 });
    let calls = tokio::select! {
        drained = &mut stopped => {
            info!("stopped");
            return drained.map_err(ServerError::from);
        }
        () = quiet(&faces) => 0,
        () = sleep_until(grace_end) => in_use(&faces),
    };
    if calls > 0 {
        warn!(calls, grace_ms, "cutting what is not done");
    } else {
        info!("cutting connections that have no calls and do not end");
    }
    cut.cancel();
    // It ends or it does not; either way this server has said what there is to say.
    let _ = timeout(CUT_WAIT, stopped).await;
    if calls > 0 {
        return Err(ServerError::Cut { calls, grace_ms });
    }
    info!("stopped");
    Ok(())
}

/// How many calls are under way.
fn in_use(faces: &[Capacity]) -> usize {
    faces.iter().map(Capacity::in_use).sum()
}

/// Returns once no call has been under way for [`QUIET_WAIT`].
async fn quiet(faces: &[Capacity]) {
    let mut ticks = interval(QUIET_WAIT / 10);
    let mut since = Instant::now();
    loop {
        let now = ticks.tick().await;
        if in_use(faces) > 0 {
            since = now;
        } else if now.saturating_duration_since(since) >= QUIET_WAIT {
            return;
        }
    }
}

/// A registry of what the log holds. Read on a thread that may block, as reading a log does.
async fn replayed(options: RegistryOptions, data: DataConfig) -> Result<Registry, ServerError> {
    let replay = move || {
        let log: Arc<dyn Log> = match data.directory() {
            Some(directory) => Arc::new(FjallLog::open(directory, data.durability)?),
            None => Arc::new(MemoryLog::default()),
        };
        let registry = Registry::new(log, options);
        registry.replay()?;
        Ok(registry)
    };
    // It fails to come back only if it panicked.
    let replayed = tokio::task::spawn_blocking(replay).await;
    replayed.unwrap_or(Err(ServerError::Ended))
}
