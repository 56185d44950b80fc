//! The queryable of the face. Zenoh asks one of several servers that declare theirs complete, always the same one. In a
//! cluster the queryable of a server that answers worse than the others is incomplete: they get its queries, and if all
//! servers are cut off, each of them answers.

use std::{sync::Arc, time::Duration};

use tokio::{
    sync::{Mutex, watch},
    time::timeout,
};
use tracing::{debug, info, warn};
use zenoh::{Session, query::Queryable};

use super::{ZenohError, queries::Queries};

/// The time between two attempts to take queries.
const RETRY_INTERVAL: Duration = Duration::from_secs(1);

/// See the module.
#[derive(Clone)]
pub(super) struct Offer {
    session: Session,
    queries: Arc<Queries>,
    /// None before a server of a cluster serves, and once the face has withdrawn.
    queryable: Arc<Mutex<Option<Queryable<()>>>>,
}

impl Offer {
    /// Takes no query yet.
    pub(super) fn new(session: &Session, queries: &Arc<Queries>) -> Self {
        Self {
            session: session.clone(),
            queries: Arc::clone(queries),
            queryable: Arc::default(),
        }
    }

    /// Takes every query under the prefix from now on, in the place of other servers too if `is_complete`.
    pub(super) async fn declare(&self, is_complete: bool) -> Result<(), ZenohError> {
        let mut queryable = self.queryable.lock().await;
        // With both, one query would be answered twice.
        undeclare(queryable.take()).await;
        let taking = Arc::clone(&self.queries);
        let declaring = self
            .session
            .declare_queryable(format!("{}/**", self.queries.prefix))
            .complete(is_complete)
            .callback(move |query| taking.take(query));
        *queryable = Some(declaring.await.map_err(ZenohError::declare)?);
        Ok(())
    }

    /// Takes no query any more.
    pub(super) async fn withdraw(&self) {
        undeclare(self.queryable.lock().await.take()).await;
    }

    /// Leaves the queries to the other servers while `fitness` is false, until it is dropped. The queryable is complete
    /// at first.
    pub(super) async fn follow(self, mut fitness: watch::Receiver<bool>) {
        let mut is_complete = Some(true);
        loop {
            let is_fit = *fitness.borrow_and_update();
            if is_complete != Some(is_fit) {
                let declared = self.declare(is_fit).await;
                is_complete = declared.is_ok().then_some(is_fit);
                match declared {
                    Ok(()) if is_fit => info!("takes queries over Zenoh again"),
                    Ok(()) => warn!(
                        "leaves queries over Zenoh to the other servers: it is cut off from NATS, or cannot open its store"
                    ),
                    Err(error) => {
                        warn!(%error, "takes no queries over Zenoh; it tries again");
                        // The fitness may change meanwhile.
                        let _ = timeout(RETRY_INTERVAL, fitness.changed()).await;
                        continue;
                    }
                }
            }
            if fitness.changed().await.is_err() {
                return;
            }
        }
    }
}

async fn undeclare(queryable: Option<Queryable<()>>) {
    if let Some(queryable) = queryable
        && let Err(error) = queryable.undeclare().await
    {
        debug!(%error, "the queryable was gone already");
    }
}
