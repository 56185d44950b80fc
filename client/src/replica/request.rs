//! Settings and start of a replica.

use std::time::Duration;

use futures_util::future::BoxFuture;
use tokio::time::Instant;

use super::{
    Replica, ReplicaView, follow::Follower, load::load, merging_forest::MergingForest,
    shared::Shared, source::Source,
};
use crate::{Client, Error};

/// Settings of a replica; await it to read all points. From then on the replica answers, and follows its index.
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

    /// Gets mutations over Zenoh instead: from the index's publications at `PREFIX/NAME/events`, and from its log if
    /// publications were lost. The session must reach the server, directly or through routers; `wayfold/v1` is the
    /// default prefix of a server. The client's server still sends all points at the start, and the revision that shows
    /// their freshness.
    #[cfg(feature = "zenoh")]
    pub fn over_zenoh(mut self, session: zenoh::Session, prefix: &str) -> ReplicaRequest {
        let publications = crate::index::shared::publications::Publications::new(session, prefix);
        self.source = Source::Zenoh(publications);
        self
    }

    /// Makes reads fail with [`Error::Stale`] if the server may have published a mutation longer ago than this that the
    /// replica does not have. The replica asks the server for its revision several times within this time, even without
    /// mutations. Unless set, reads never fail for this reason.
    pub fn max_staleness(mut self, bound: Duration) -> ReplicaRequest {
        self.max_staleness = Some(bound);
        self
    }

    /// The time for which no index may have the name before the replica ends: 5 s unless set. The replica continues
    /// with an index that is deleted and created again within this time, also after a restart of a server without a
    /// disk.
    pub fn missing_for(mut self, time: Duration) -> ReplicaRequest {
        self.missing_for = time;
        self
    }

    async fn send(self) -> Result<Replica, Error> {
        let at = Instant::now();
        let index = self.client.index(&self.name).await?;
        let forest = MergingForest::new(load(&index).await?);
        let view = ReplicaView::new(index, forest.snapshot());
        let shared = Shared::new(view, at, self.max_staleness);
        let follower = Follower::new(
            self.client,
            shared.clone(),
            forest,
            self.source,
            heartbeat(self.max_staleness),
            self.missing_for,
        );
        let task = tokio::spawn(follower.run()).abort_handle();
        Ok(Replica::new(shared, task))
    }
}

/// The period at which the replica asks a silent server for its revision.
fn heartbeat(max_staleness: Option<Duration>) -> Duration {
    const MAX: Duration = Duration::from_secs(1);
    const MIN: Duration = Duration::from_millis(1);
    let within = max_staleness.map_or(MAX, |bound| bound / 4);
    within.clamp(MIN, MAX)
}

impl IntoFuture for ReplicaRequest {
    type Output = Result<Replica, Error>;
    type IntoFuture = BoxFuture<'static, Self::Output>;

    fn into_future(self) -> Self::IntoFuture {
        Box::pin(self.send())
    }
}
