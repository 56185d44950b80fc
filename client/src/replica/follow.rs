//! The task that keeps a replica at the server's revision.

use std::{pin::Pin, sync::Arc, time::Duration};

use tokio::time::Instant;

use super::{ReplicaStatus, ReplicaView, grove::Grove, load::load, shared::Shared, source::Source};
use crate::{Client, Code, Error, IndexHandle, Reset, ResetReason, Watch, WatchEvent};

pub(super) struct Follower {
    client: Client,
    shared: Arc<Shared>,
    index: IndexHandle,
    uid: Arc<str>,
    grove: Grove,
    source: Source,
    heartbeat: Duration,
    missing_for: Duration,
    /// When the connection was lost.
    lost: Option<Instant>,
    /// Since when no index has the name.
    missing: Option<Instant>,
    /// How many tries failed in a row.
    failures: u32,
}

/// Why following stopped.
enum Stop {
    /// The server cannot tell what comes next.
    Reset(Reset),
    /// The connection, or the try to get one, failed.
    Failed(Error),
}

impl From<Error> for Stop {
    fn from(error: Error) -> Stop {
        Stop::Failed(error)
    }
}

/// A word of the server: at `asked`, nothing newer than `revision` was published.
struct Word {
    asked: Instant,
    revision: u64,
}

type Heartbeat = Pin<Box<dyn Future<Output = Result<Option<Word>, Error>> + Send>>;

impl Follower {
    pub(super) fn new(
        client: Client,
        shared: Arc<Shared>,
        grove: Grove,
        source: Source,
        heartbeat: Duration,
        missing_for: Duration,
    ) -> Follower {
        let index = shared.published().index().clone();
        Follower {
            client,
            uid: index.uid().into(),
            index,
            shared,
            grove,
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
                match self.load_anew(&reset).await {
                    Ok(()) => continue,
                    Err(error) => stopped = Stop::Failed(error),
                }
            }
            if let Stop::Failed(error) = stopped
                && let Err(why) = self.recover(error).await
            {
                return self.shared.tell_end(why);
            }
        }
    }

    /// Applies what the server tells, until it cannot go on.
    async fn follow(&mut self) -> Stop {
        match self.follow_watch().await {
            Ok(never) => match never {},
            Err(stop) => stop,
        }
    }

    async fn follow_watch(&mut self) -> Result<std::convert::Infallible, Stop> {
        let asked = Instant::now();
        let after = self.grove.revision();
        let watch = self.source.watch(&self.index, after, self.heartbeat);
        let mut watch = watch.await?;
        // A reset may be all that it tells, and there may be mutations already.
        while let Some(event) = watch.ready() {
            self.apply(event)?;
        }
        self.publish();
        let mut word = Some(Word {
            asked,
            revision: watch.newest(),
        });
        let mut heartbeat = self.heartbeat();
        loop {
            self.following(&watch, &mut word);
            tokio::select! {
                event = watch.next() => {
                    let mut next = event?;
                    while let Some(event) = next {
                        self.apply(event)?;
                        next = watch.ready();
                    }
                    self.publish();
                }
                () = self.grove.merged() => self.publish(),
                heard = &mut heartbeat => {
                    // A word that is still waited for is older, and its revision is reached first.
                    let heard = heard?;
                    word = word.or(heard);
                    self.grove.look_for_pause();
                    heartbeat = self.heartbeat();
                }
            }
        }
    }

    /// Takes note that the server is heard, and of how fresh the points are.
    fn following(&mut self, watch: &Watch, word: &mut Option<Word>) {
        (self.lost, self.missing, self.failures) = (None, None, 0);
        let revision = self.grove.revision();
        if let Some(heard) = word.take_if(|word| word.revision <= revision) {
            self.shared.fresh_at(heard.asked);
        }
        self.shared.tell(ReplicaStatus::Following {
            revision,
            behind: watch.newest().saturating_sub(revision),
        });
    }

    fn apply(&mut self, event: WatchEvent) -> Result<(), Stop> {
        match event {
            WatchEvent::Mutation(mutation) => {
                self.grove.apply(&mutation)?;
                Ok(())
            }
            WatchEvent::Reset(reset) => {
                // What came before it is good.
                self.publish();
                Err(Stop::Reset(reset))
            }
        }
    }

    /// Lets readers see the forest as it is.
    fn publish(&self) {
        let (index, uid) = (self.index.clone(), Arc::clone(&self.uid));
        let view = ReplicaView::new(index, uid, self.grove.snapshot());
        self.shared.publish(view);
    }

    /// Asks, after a while, for the server's revision. None if the index has another uid, of which the watch will tell.
    fn heartbeat(&self) -> Heartbeat {
        let (index, at) = (self.index.clone(), Instant::now() + self.heartbeat);
        Box::pin(async move {
            tokio::time::sleep_until(at).await;
            let asked = Instant::now();
            let info = index.info().await?;
            Ok((info.uid == index.uid()).then_some(Word {
                asked,
                revision: info.revision,
            }))
        })
    }

    /// Reads all points, beside those that there are, and publishes them.
    async fn load_anew(&mut self, reset: &Reset) -> Result<(), Error> {
        self.shared.tell(ReplicaStatus::CatchingUp {
            revision: self.grove.revision(),
        });
        let asked = Instant::now();
        let index = match reset.reason {
            ResetReason::WindowPassed => self.index.clone(),
            ResetReason::UidChanged | ResetReason::Other(_) => {
                self.client.index(self.index.name()).await?
            }
        };
        self.grove = Grove::new(load(&index).await?);
        self.uid = index.uid().into();
        self.index = index;
        self.publish();
        self.shared.fresh_at(asked);
        // For those who wait for what is published.
        self.shared.tell(ReplicaStatus::CatchingUp {
            revision: self.grove.revision(),
        });
        Ok(())
    }

    /// Waits before the next try; or tells why there is to be none.
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
        self.shared.tell(ReplicaStatus::Disconnected { since, why });
        self.failures = self.failures.saturating_add(1);
        let until = now + self.client.retry_policy().endless_pause(self.failures);
        loop {
            tokio::select! {
                () = tokio::time::sleep_until(until) => return Ok(()),
                () = self.grove.merged() => self.publish(),
            }
        }
    }
}

impl Drop for Follower {
    /// Readers are told also where the task does not come to its end: its runtime is shut down, or it panicked.
    fn drop(&mut self) {
        self.shared.end(|| Error::Connection {
            call: "replica",
            uri: self.client.uri().to_owned(),
            source: "the task that follows the server was stopped".into(),
        });
    }
}
