//! The waits for a server that lacks the newest revision that the handle has seen.

use std::time::Duration;

use wayfold_proto::v1;

use super::IndexHandle;
use crate::net::{client::within, connections::Connection};

impl IndexHandle {
    /// Waits until the server has the newest revision that the handle has seen, if there are several servers.
    pub(super) async fn catch_up(
        &self,
        connection: &Connection,
        remaining: Duration,
        patience: Duration,
    ) -> Result<(), tonic::Status> {
        let newest = &self.shared.newest;
        if !self.client().connections().are_several() || newest.is_reached_in(connection.turn()) {
            return Ok(());
        }
        self.wait_for_newest(connection, remaining, patience)
            .await?;
        newest.set_reached_in(connection.turn());
        Ok(())
    }

    /// Waits until the server has the newest revision that the handle has seen.
    pub(crate) async fn wait_for_newest(
        &self,
        connection: &Connection,
        remaining: Duration,
        patience: Duration,
    ) -> Result<(), tonic::Status> {
        let newest = self.shared.newest.number();
        self.wait_for(newest, connection, remaining, patience).await
    }

    /// Waits until the server has this revision. A wait that `patience` ends before `remaining` is over fails with
    /// `UNAVAILABLE`, so that the next attempt asks another server.
    pub(super) async fn wait_for(
        &self,
        revision: u64,
        connection: &Connection,
        remaining: Duration,
        patience: Duration,
    ) -> Result<(), tonic::Status> {
        if revision == 0 {
            return Ok(());
        }
        let request = v1::GetRequest {
            index_name: self.name().to_owned(),
            min_revision: Some(self.revision_at(revision).to_message()),
            ..Default::default()
        };
        let wait = remaining.min(patience);
        let waited = connection.points().get(within(wait, request)).await;
        let Err(status) = waited else {
            return Ok(());
        };
        Err(match status.code() {
            // The transport may give up before the server does, and calls that a cancellation.
            tonic::Code::DeadlineExceeded | tonic::Code::Cancelled if wait < remaining => {
                let mut lagging = tonic::Status::unavailable(
                    "the server lacks the newest revision that this client has seen",
                );
                // No answer to the call: an earlier attempt may have taken effect.
                lagging.set_source(std::sync::Arc::new(status));
                lagging
            }
            _ => status,
        })
    }
}
