//! Settings of a replica, and its beginning.

use std::time::Duration;

use futures_util::future::BoxFuture;
use tokio::time::Instant;

use super::{Replica, follow::Follower, grove::Grove, load::load, shared::Shared, source::Source};
use crate::{Client, Error};

/// Begins a replica; await it to read all points. From then on it answers, and follows.
#[derive(Clone, Debug)]
#[must_use = "a request does nothing until it is awaited"]
pub struct ReplicaRequest {
    client: Client,
    name: String,
    max_staleness: Option<Duration>,
    missing_for: Duration,
    source: Source,
}

impl ReplicaRequest {
    pub(crate) fn new(client: Client, name: &str) -> ReplicaRequest {
        ReplicaRequest {
            client,
            name: name.to_owned(),
            max_staleness: None,
            missing_for: Duration::from_secs(5),
            source: Source::Server,
        }
    }

    /// Hears of mutations over Zenoh instead: what the index publishes as `PREFIX/NAME/events`, and its log for what was
    /// lost on the way. The session must reach the server, directly or through routers; `wayfold/v1` is the prefix of
    /// a server with its own settings. All points are read from the client's server, which says too how fresh they are.
    #[cfg(feature = "zenoh")]
    pub fn over_zenoh(mut self, session: zenoh::Session, prefix: &str) -> ReplicaRequest {
        let publications = super::publications::Publications::new(session, prefix);
        self.source = Source::Zenoh(publications);
        self
    }

    /// Reads fail with [`Error::Stale`] where the server may have published, longer ago than this, what the replica has
    /// not: it is asked several times within this time, also where nothing is mutated. Unless set, reads always answer.
    pub fn max_staleness(mut self, bound: Duration) -> ReplicaRequest {
        self.max_staleness = Some(bound);
        self
    }

    /// How long no index may have the name before the replica ends: 5 s unless set. One that is deleted and made anew
    /// within this time is followed, and so is one that a server without a disk is given again after a restart.
    pub fn missing_for(mut self, time: Duration) -> ReplicaRequest {
        self.missing_for = time;
        self
    }

    async fn send(self) -> Result<Replica, Error> {
        let asked = Instant::now();
        let index = self.client.index(&self.name).await?;
        let grove = Grove::new(load(&index).await?);
        let uid = index.uid().into();
        let view = super::ReplicaView::new(index, uid, grove.snapshot());
        let shared = Shared::new(view, asked, self.max_staleness);
        let follower = Follower::new(
            self.client,
            shared.clone(),
            grove,
            self.source,
            heartbeat(self.max_staleness),
            self.missing_for,
        );
        let task = tokio::spawn(follower.run()).abort_handle();
        Ok(Replica::new(shared, task))
    }
}

/// How often a server that says nothing is asked for its revision.
fn heartbeat(max_staleness: Option<Duration>) -> Duration {
    const LONGEST: Duration = Duration::from_secs(1);
    const SHORTEST: Duration = Duration::from_millis(1);
    let within = max_staleness.map_or(LONGEST, |bound| bound / 4);
    within.clamp(SHORTEST, LONGEST)
}

impl IntoFuture for ReplicaRequest {
    type Output = Result<Replica, Error>;
    type IntoFuture = BoxFuture<'static, Self::Output>;

    fn into_future(self) -> Self::IntoFuture {
        Box::pin(self.send())
    }
}
