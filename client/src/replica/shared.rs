//! The state that the following task shares with readers.

use std::{
    sync::{
        Arc, OnceLock,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use arc_swap::{ArcSwap, Guard};
use tokio::{
    sync::watch,
    time::{Instant, timeout},
};

use super::{ReplicaStatus, ReplicaView};
use crate::{Error, Revision};

#[derive(Debug)]
pub(super) struct Shared {
    published: ArcSwap<ReplicaView>,
    status: watch::Sender<ReplicaStatus>,
    /// Nanoseconds from `start` to a time at which `published` had everything that the server had published.
    fresh: AtomicU64,
    start: Instant,
    max_staleness: Option<Duration>,
    ended: OnceLock<Arc<Error>>,
}

impl Shared {
    /// `view` has everything that the server had published at `at`.
    pub(super) fn new(
        view: ReplicaView,
        at: Instant,
        max_staleness: Option<Duration>,
    ) -> Arc<Shared> {
        let status = ReplicaStatus::CatchingUp {
            revision: view.revision(),
        };
        Arc::new(Shared {
            published: ArcSwap::from_pointee(view),
            status: watch::Sender::new(status),
            fresh: AtomicU64::new(0),
            start: at,
            max_staleness,
            ended: OnceLock::new(),
        })
    }

    pub(super) fn published(&self) -> Guard<Arc<ReplicaView>> {
        self.published.load()
    }

    pub(super) fn publish(&self, view: ReplicaView) {
        self.published.store(Arc::new(view));
    }

    pub(super) fn set_status(&self, status: ReplicaStatus) {
        self.status.send_replace(status);
    }

    pub(super) fn set_end(&self, why: Arc<Error>) {
        // Only the first cause counts.
        if self.ended.set(Arc::clone(&why)).is_ok() {
            self.set_status(ReplicaStatus::Ended { why });
        }
    }

    /// Ends the replica, if it has not ended.
    pub(super) fn end(&self, why: impl FnOnce() -> Error) {
        if self.ended.get().is_none() {
            self.set_end(Arc::new(why()));
        }
    }

    pub(super) fn status(&self) -> ReplicaStatus {
        self.status.borrow().clone()
    }

    pub(super) async fn status_where(
        &self,
        wanted: impl FnMut(&ReplicaStatus) -> bool,
    ) -> ReplicaStatus {
        let mut status = self.status.subscribe();
        match status.wait_for(wanted).await {
            Ok(status) => status.clone(),
            // The sender lives as long as `self`.
            Err(_) => self.status(),
        }
    }

    /// Records that `published` has everything that the server had published at `at`.
    pub(super) fn fresh_at(&self, at: Instant) {
        let nanos = at.saturating_duration_since(self.start).as_nanos();
        let nanos = u64::try_from(nanos).unwrap_or(u64::MAX);
        self.fresh.fetch_max(nanos, Ordering::Release);
    }

    pub(super) fn staleness(&self) -> Duration {
        let fresh = Duration::from_nanos(self.fresh.load(Ordering::Acquire));
        Instant::now().saturating_duration_since(self.start + fresh)
    }

    /// Returns an error if reads may not be answered.
    pub(super) fn check(&self) -> Result<(), Error> {
        if let Some(why) = self.ended.get() {
            return Err(ended(why));
        }
        let Some(bound) = self.max_staleness else {
            return Ok(());
        };
        match self.staleness() {
            age if age > bound => Err(Error::Stale { age, bound }),
            _ => Ok(()),
        }
    }

    /// Waits until a revision is published.
    pub(super) async fn reached(
        &self,
        revision: &Revision,
        within: Duration,
    ) -> Result<ReplicaView, Error> {
        let mut status = self.status.subscribe();
        let reached = async {
            loop {
                let published = self.published.load();
                let current = published.revision();
                revision.check_uid(&current.uid)?;
                if current.number >= revision.number {
                    return Ok(ReplicaView::clone(&published));
                }
                drop(published);
                if let Some(why) = self.ended.get() {
                    return Err(ended(why));
                }
                // It changes after each published revision, and the sender lives as long as `self`.
                let _ = status.changed().await;
            }
        };
        timeout(within, reached)
            .await
            .map_err(|_| Error::timeout("replica", within))?
    }
}

fn ended(why: &Arc<Error>) -> Error {
    Error::Ended {
        why: Arc::clone(why),
    }
}
