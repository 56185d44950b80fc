//! The link over gRPC.

use std::time::Duration;

use futures_util::{StreamExt, TryStreamExt};

use super::{
    call::Call,
    load::{COLUMNS, Part, Parts},
};
use crate::{
    Client, Credentials, Error, IndexHandle, RetryPolicy, Watch,
    index::shared::served_index::ServedIndex,
    net::{client::within, connections::Connection},
};

/// The client of the servers.
#[derive(Clone, Debug)]
pub(super) struct GrpcLink(Client);

impl GrpcLink {
    pub(super) async fn connect(
        uri: &str,
        timeout: Duration,
        credentials: Credentials,
    ) -> Result<GrpcLink, Error> {
        let builder = Client::builder().timeout(timeout);
        let connected = builder.credentials(credentials).connect(uri).await;
        connected.map(GrpcLink)
    }

    pub(super) async fn call<C: Call>(&self, request: &C) -> Result<C::Answer, Error> {
        let attempt = |connection: Connection, remaining| {
            C::send(connection, within(remaining, request.clone()))
        };
        self.0.call(C::NAME, self.0.timeout(), attempt).await
    }

    /// True if the client has several servers.
    pub(super) fn has_others(&self) -> bool {
        self.0.connections().are_several()
    }

    /// Makes the next calls at another server, if there is one.
    pub(super) fn leave(&self) {
        self.0.connections().leave(&self.0.connection());
    }

    pub(super) fn retry_policy(&self) -> RetryPolicy {
        self.0.retry_policy()
    }

    /// Watches an index after a revision, without the points that `own_session` stores.
    pub(super) async fn watch(
        &self,
        index: &ServedIndex,
        after: u64,
        own_session: u64,
    ) -> Result<Watch, Error> {
        let watch = self.handle(index, after).watch();
        let watch = watch.after(index.revision_at(after));
        watch.own_session(own_session).await
    }

    /// All points of an index.
    pub(super) async fn scan(&self, index: &ServedIndex) -> Result<Parts, Error> {
        let scan = self.handle(index, 0).scan().include(COLUMNS).await?;
        let total = scan.point_count();
        let parts = scan.into_stream();
        Ok(parts.map_ok(move |points| Part { points, total }).boxed())
    }

    fn handle(&self, index: &ServedIndex, at: u64) -> IndexHandle {
        let (name, space) = (index.name().to_owned(), index.space().clone());
        IndexHandle::of(self.0.clone(), name, space, index.revision_at(at))
    }
}
