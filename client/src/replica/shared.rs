//! What the task that follows shares with the readers.

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
use crate::{Code, Error, Refusal};

#[derive(Debug)]
pub(super) struct Shared {
    published: ArcSwap<ReplicaView>,
    status: watch::Sender<ReplicaStatus>,
    /// Nanoseconds from `start` to a time at which nothing was published that is not in `published`.
    fresh: AtomicU64,
    start: Instant,
    max_staleness: Option<Duration>,
    ended: OnceLock<Arc<Error>>,
}

impl Shared {
    /// `view` has all that was published at `asked`.
    pub(super) fn new(
        view: ReplicaView,
        asked: Instant,
        max_staleness: Option<Duration>,
    ) -> Arc<Shared> {
        let status = ReplicaStatus::CatchingUp {
            revision: view.revision(),
        };
        Arc::new(Shared {
            published: ArcSwap::from_pointee(view),
            status: watch::Sender::new(status),
            fresh: AtomicU64::new(0),
            start: asked,
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

    pub(super) fn tell(&self, status: ReplicaStatus) {
        self.status.send_replace(status);
    }

    pub(super) fn tell_end(&self, why: Arc<Error>) {
        // There is one end.
        if self.ended.set(Arc::clone(&why)).is_ok() {
            self.tell(ReplicaStatus::Ended { why });
        }
    }

    /// Tells an end, if there was none.
    pub(super) fn end(&self, why: impl FnOnce() -> Error) {
        if self.ended.get().is_none() {
            self.tell_end(Arc::new(why()));
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
            // Not while the sender is here.
            Err(_) => self.status(),
        }
    }

    /// Takes note that what is published has all that was published by the server at `asked`.
    pub(super) fn fresh_at(&self, asked: Instant) {
        let nanos = asked.saturating_duration_since(self.start).as_nanos();
        let nanos = u64::try_from(nanos).unwrap_or(u64::MAX);
        self.fresh.fetch_max(nanos, Ordering::Release);
    }

    pub(super) fn staleness(&self) -> Duration {
        let fresh = Duration::from_nanos(self.fresh.load(Ordering::Acquire));
        Instant::now().saturating_duration_since(self.start + fresh)
    }

    /// Whether reads may be answered.
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

    /// Waits until a revision of a uid is published.
    pub(super) async fn reached(
        &self,
        uid: &str,
        revision: u64,
        within: Duration,
    ) -> Result<ReplicaView, Error> {
        let mut status = self.status.subscribe();
        let reached = async {
            loop {
                let published = self.published.load();
                if published.uid() != uid {
                    return Err(other_uid(uid, published.uid()));
                }
                if published.revision() >= revision {
                    return Ok(ReplicaView::clone(&published));
                }
                drop(published);
                if let Some(why) = self.ended.get() {
                    return Err(ended(why));
                }
                // It changes after each revision that is published; and never without a sender.
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

/// As the server refuses a call of another uid.
fn other_uid(asked: &str, found: &str) -> Error {
    let metadata = [("asked", asked), ("found", found)];
    let metadata = metadata.map(|(key, value)| (key.to_owned(), value.to_owned()));
    Error::Refused(Box::new(Refusal {
        code: Code::FailedPrecondition,
        message: format!(
            "the replica stands at the uid {found}, not {asked}: the index was made anew"
        ),
        reason: "UID_MISMATCH".to_owned(),
        metadata: metadata.into(),
        fields: Vec::new(),
        ids: Vec::new(),
    }))
}
