//! The task that keeps a replica at the server's revision.

use std::{pin::Pin, sync::Arc, time::Duration};

use tokio::time::Instant;

use super::{
    ReplicaStatus, ReplicaView, load::load, merging_forest::MergingForest, shared::Shared,
    source::Source,
};
use crate::{Client, Code, Error, IndexHandle, Reset, ResetReason, Revision, Watch, WatchEvent};

pub(super) struct Follower {
    client: Client,
    shared: Arc<Shared>,
    index: IndexHandle,
    forest: MergingForest,
    source: Source,
    heartbeat: Duration,
    missing_for: Duration,
    /// The time at which the connection was lost.
    lost: Option<Instant>,
    /// The time since which no index has the name.
    missing: Option<Instant>,
    /// The number of attempts that failed in a row.
    failures: u32,
}

/// The reason for which following stopped.
enum Stop {
    /// The server cannot send the next mutations.
    Reset(Reset),
    /// The connection, or the attempt to get one, failed.
    Failed(Error),
}

impl From<Error> for Stop {
    fn from(error: Error) -> Stop {
        Stop::Failed(error)
    }
}

/// A proof of freshness: at the time `at`, the server had published nothing newer than `revision`.
struct FreshnessProof {
    at: Instant,
    revision: u64,
}

type Heartbeat = Pin<Box<dyn Future<Output = Result<Option<FreshnessProof>, Error>> + Send>>;

impl Follower {
    pub(super) fn new(
        client: Client,
        shared: Arc<Shared>,
        forest: MergingForest,
        source: Source,
        heartbeat: Duration,
        missing_for: Duration,
    ) -> Follower {
        let index = shared.published().index().clone();
        Follower {
            client,
            index,
            shared,
            forest,
            source,
            heartbeat,
            missing_for,
            lost: None,
            missing: None,
            failures: 0,
        }
    }

    /// Follows until the index is gone for good.
    pub(super) async fn run(mut self) {
        loop {
            let mut stopped = self.follow().await;
            if let Stop::Reset(reset) = stopped {
                match self.reload(&reset).await {
                    Ok(()) => continue,
                    Err(error) => stopped = Stop::Failed(error),
                }
            }
            if let Stop::Failed(error) = stopped
                && let Err(why) = self.recover(error).await
            {
                return self.shared.set_end(why);
            }
        }
    }

    /// Applies the server's mutations until an error or a reset stops it.
    async fn follow(&mut self) -> Stop {
        match self.follow_watch().await {
            Ok(never) => match never {},
            Err(stop) => stop,
        }
    }

    async fn follow_watch(&mut self) -> Result<std::convert::Infallible, Stop> {
        let at = Instant::now();
        let after = self.index.revision_at(self.forest.revision());
        let watch = self.source.watch(&self.index, after, self.heartbeat);
        let mut watch = watch.await?;
        // A reset may be the only event, and mutations may have arrived already.
        while let Some(event) = watch.ready() {
            self.apply(event)?;
        }
        self.publish();
        let mut proof = Some(FreshnessProof {
            at,
            revision: watch.newest().number,
        });
        let mut heartbeat = self.heartbeat();
        loop {
            self.note_following(&watch, &mut proof);
            tokio::select! {
                event = watch.next() => {
                    let mut next = event?;
                    while let Some(event) = next {
                        self.apply(event)?;
                        next = watch.ready();
                    }
                    self.publish();
                }
                () = self.forest.merged() => self.publish(),
                newer = &mut heartbeat => {
                    // The earlier proof's revision is reached first.
                    let newer = newer?;
                    proof = proof.or(newer);
                    self.forest.check_for_pause();
                    heartbeat = self.heartbeat();
                }
            }
        }
    }

    /// Records that the connection stands, and the freshness of the points.
    fn note_following(&mut self, watch: &Watch, proof: &mut Option<FreshnessProof>) {
        (self.lost, self.missing, self.failures) = (None, None, 0);
        let number = self.forest.revision();
        if let Some(proof) = proof.take_if(|proof| proof.revision <= number) {
            self.shared.fresh_at(proof.at);
        }
        self.shared.set_status(ReplicaStatus::Following {
            revision: self.index.revision_at(number),
            behind: watch.newest().number.saturating_sub(number),
        });
    }

    fn apply(&mut self, event: WatchEvent) -> Result<(), Stop> {
        match event {
            WatchEvent::Mutation(mutation) => {
                self.forest.apply(&mutation)?;
                Ok(())
            }
            WatchEvent::Reset(reset) => {
                // The mutations before the error are good.
                self.publish();
                Err(Stop::Reset(reset))
            }
        }
    }

    /// Publishes the forest to readers.
    fn publish(&self) {
        let view = ReplicaView::new(self.index.clone(), self.forest.snapshot());
        self.shared.publish(view);
    }

    /// Asks for the server's revision after a while. `None` if the index has another uid, which the watch will report.
    fn heartbeat(&self) -> Heartbeat {
        let (index, at) = (self.index.clone(), Instant::now() + self.heartbeat);
        Box::pin(async move {
            tokio::time::sleep_until(at).await;
            let at = Instant::now();
            let Revision { uid, number } = index.info().await?.revision;
            Ok((*uid == *index.uid()).then_some(FreshnessProof {
                at,
                revision: number,
            }))
        })
    }

    /// Reads all points into a second forest, and publishes it in the place of the first.
    async fn reload(&mut self, reset: &Reset) -> Result<(), Error> {
        self.set_catching_up();
        let at = Instant::now();
        let index = match reset.reason {
            ResetReason::WindowPassed => self.index.clone(),
            ResetReason::UidChanged | ResetReason::Other(_) => {
                self.client.index(self.index.name()).await?
            }
        };
        self.forest = MergingForest::new(load(&index).await?);
        self.index = index;
        self.publish();
        self.shared.fresh_at(at);
        // Wakes callers that wait for a published revision.
        self.set_catching_up();
        Ok(())
    }

    fn set_catching_up(&self) {
        let revision = self.index.revision_at(self.forest.revision());
        self.shared
            .set_status(ReplicaStatus::CatchingUp { revision });
    }

    /// Waits before the next attempt, or returns the reason to make none.
    async fn recover(&mut self, error: Error) -> Result<(), Arc<Error>> {
        let (code, now) = (error.code(), Instant::now());
        let why = Arc::new(error);
        match code {
            Code::NotFound => {
                let since = *self.missing.get_or_insert(now);
                if now.duration_since(since) >= self.missing_for {
                    return Err(why);
                }
            }
            // A server that cannot be followed.
            Code::Unimplemented => return Err(why),
            _ => self.missing = None,
        }
        let since = *self.lost.get_or_insert(now);
        self.shared
            .set_status(ReplicaStatus::Disconnected { since, why });
        self.failures = self.failures.saturating_add(1);
        let until = now + self.client.retry_policy().endless_pause(self.failures);
        loop {
            tokio::select! {
                () = tokio::time::sleep_until(until) => return Ok(()),
                () = self.forest.merged() => self.publish(),
            }
        }
    }
}

impl Drop for Follower {
    /// Reads also fail if the task is dropped before its end, by a shutdown of its runtime or by a panic.
    fn drop(&mut self) {
        self.shared.end(|| Error::Connection {
            call: "replica",
            uri: self.client.uri().to_owned(),
            source: "the task that follows the server was stopped".into(),
        });
    }
}
