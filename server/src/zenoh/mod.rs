//! The Zenoh face: translates queries to calls of the service and back, publishes mutations as `Watch` reports them,
//! and holds no policy of its own.
//!
//! `<prefix>/<index>/<verb>` and `<prefix>/<verb>` take queries; the prefix is `wayfold/v1` unless set. A query has a
//! selector with parameters and a payload in Protocol Buffers or JSON (`encoding`, `crate::verbs`), and gets one reply
//! (`offer`, `queries`, `flows`, `inline`, `response`). A query with a wildcard (`wildcard`) reaches only descriptions of
//! indices. `feed` announces `<index>/events` and `<index>/@alive`. `session` opens the session with its access control,
//! `links` measures and logs its links, and `servers` finds other servers under the prefix.

mod encoding;
mod feed;
mod flows;
mod inline;
mod links;
mod offer;
mod queries;
mod response;
mod servers;
mod session;
mod wildcard;

use std::{sync::Arc, time::Duration};

use tokio::{runtime::Handle, sync::Semaphore, time::interval};
use tokio_util::{
    sync::CancellationToken,
    task::{AbortOnDropHandle, TaskTracker},
};
use tracing::{info, warn};
use zenoh::{Session, key_expr::KeyExpr};

pub use session::ZenohError;
pub(crate) use session::{MAX_PENDING, MAX_SESSIONS, exposed};

use crate::{admission::CallPlaces, config::ZenohConfig, faces::FaceContext};
use feed::Announcer;
use flows::Flows;
use inline::Inline;
use links::Links;
use offer::Offer;
use queries::Queries;
use servers::ServerWatch;
use session::ZenohRuntime;

/// Time that links stay open after the last answer. Zenoh closes a link at once; a peer that sends to a closed link
/// loses its unread answers.
const LINGER: Duration = Duration::from_secs(1);

/// Refusals that may wait for their links, one thread each. Beyond it, links of refused queries are not read.
const MAX_REFUSALS: usize = 256;

/// Threads that may wait for links at once: callers that read no answers must not take the threads of others.
pub(crate) fn max_senders(config: &ZenohConfig) -> usize {
    // Calls of administration have as many places as the others.
    let calls = config.max_calls.saturating_mul(2);
    calls.saturating_add(MAX_REFUSALS)
}

/// The open face.
pub(crate) struct ZenohFace {
    open: ZenohRuntime,
    offer: Offer,
    queries: Arc<Queries>,
    /// True if other servers under the prefix share the indices.
    in_cluster: bool,
    announcing: Option<AbortOnDropHandle<()>>,
    /// In a cluster, the task that leaves queries to the other servers.
    offering: Option<AbortOnDropHandle<()>>,
    _servers: ServerWatch,
    _links: Option<AbortOnDropHandle<()>>,
}

impl ZenohFace {
    /// Opens the face; None if the settings turn it off. It answers queries from now on, with UNAVAILABLE until the
    /// service serves. In a cluster it takes none until then: the other servers answer them.
    pub(crate) async fn open(
        config: &ZenohConfig,
        shared: FaceContext,
        in_cluster: bool,
    ) -> Result<Option<Self>, ZenohError> {
        if config.is_off() {
            return Ok(None);
        }
        check_prefix(&config.prefix)?;
        let (open, connects_to) = session::open(config).await?;
        let session = open.session.clone();
        shared.metrics.add(Links {
            session: session.clone(),
            runtime: open.runtime.clone(),
        });
        let queries = Arc::new(Queries {
            flows: Flows::new(shared.admission.clone()),
            shared,
            prefix: config.prefix.clone(),
            places: CallPlaces::new(config.max_calls),
            admin_places: CallPlaces::new(config.max_calls),
            max_calls: config.max_calls,
            refusals: Arc::new(Semaphore::new(MAX_REFUSALS)),
            default_timeout: Duration::from_millis(config.default_timeout_ms),
            max_message_bytes: config.max_message_bytes,
            stopping: CancellationToken::new(),
            inline: Arc::new(Inline::new(Handle::current())),
            under_way: TaskTracker::new(),
        });
        let offer = Offer::new(&session, &queries);
        if !in_cluster {
            offer.declare(true).await?;
        }
        let servers = ServerWatch::watch(&session, &config.prefix, !in_cluster).await?;
        let links = connects_to.map(|endpoints| {
            let reporting = links::report_links(session.clone(), endpoints);
            AbortOnDropHandle::new(tokio::spawn(reporting))
        });
        let face = Self {
            open,
            offer,
            queries,
            in_cluster,
            announcing: None,
            offering: None,
            _servers: servers,
            _links: links,
        };
        let locators = face.locators().await;
        info!(?locators, prefix = config.prefix, "Zenoh is open");
        Ok(Some(face))
    }

    /// Its locators: `tcp/127.0.0.1:7448`.
    pub(crate) async fn locators(&self) -> Vec<String> {
        let locators = self.open.session.info().locators().await;
        locators.iter().map(ToString::to_string).collect()
    }

    /// The queries in progress.
    pub(crate) fn under_way(&self) -> TaskTracker {
        self.queries.under_way.clone()
    }

    /// Begins to announce the indices, and to publish their mutations if `publishes`; the service must have them.
    pub(crate) async fn announce(&mut self, publishes: bool) -> Result<(), ZenohError> {
        if self.in_cluster {
            self.offer.declare(true).await?;
            let fitness = self.queries.shared.service.fitness();
            let following = fitness.map(|fitness| self.offer.clone().follow(fitness));
            self.offering = following.map(|it| AbortOnDropHandle::new(tokio::spawn(it)));
        }
        let announcer = Announcer {
            service: self.queries.shared.service.clone(),
            session: self.open.session.clone(),
            prefix: self.queries.prefix.clone(),
            stopping: self.queries.stopping.clone(),
            publishes,
        };
        self.announcing = Some(AbortOnDropHandle::new(tokio::spawn(announcer.run())));
        Ok(())
    }

    /// Refuses new queries, answers accepted ones, leaves callers a moment to read the answers, and closes the session.
    pub(crate) async fn stop(self) {
        let session = self.open.session.clone();
        self.stop_after(linger(&session)).await;
    }

    /// Does the work of [`stop`](Self::stop), but leaves callers until `lingered` to read the answers.
    async fn stop_after(self, lingered: impl Future<Output = ()>) {
        if let Some(offering) = self.offering {
            offering.abort();
            // It may be about to declare the queryable.
            let _ = offering.await;
        }
        if self.in_cluster {
            // The other servers answer from now on.
            self.offer.withdraw().await;
        }
        self.queries.stopping.cancel();
        drop(self.announcing);
        self.queries.under_way.close();
        self.queries.under_way.wait().await;
        // The queryable refuses those who ask meanwhile: without it they would get no reply.
        lingered.await;
        self.offer.withdraw().await;
        if let Err(error) = self.open.session.close().await {
            warn!(%error, "the Zenoh session did not close well");
        }
        if let Err(error) = self.open.runtime.close().await {
            warn!(%error, "the links of Zenoh did not close well");
        }
    }
}

/// Returns after [`LINGER`], or once no link is left.
async fn linger(session: &Session) {
    let gone = async {
        let mut ticks = interval(LINGER / 50);
        while session.info().transports().await.next().is_some() {
            ticks.tick().await;
        }
    };
    // A caller that is still linked has had its time.
    let _ = tokio::time::timeout(LINGER, gone).await;
}

fn check_prefix(prefix: &str) -> Result<(), ZenohError> {
    let wrong = |problem: String| ZenohError::Prefix {
        prefix: prefix.to_owned(),
        problem,
    };
    let key = KeyExpr::try_from(prefix).map_err(|error| wrong(error.to_string()))?;
    if key.is_wild() || prefix.contains(['@', '$']) {
        return Err(wrong(
            "it has a wildcard, or a part that wildcards do not reach".into(),
        ));
    }
    Ok(())
}

#[cfg(test)]
mod access_tests;
#[cfg(test)]
mod tests;
