//! The waits for a server that lacks the newest revision that the handle has seen.

use std::{error::Error, future::pending, time::Duration};

use tokio::time::{Instant, sleep_until};
use wayfold_proto::v1;

use super::IndexHandle;
use crate::net::{client::within, connections::Connection};

/// A server without an answer to a call after this time is asked whether it lags. Most calls take less.
const SLOW_TIME: Duration = Duration::from_secs(1);

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

    /// Returns the failure of a slow call whose server turns out to lag, if there are several servers. The server may have begun
    /// to lag after [`IndexHandle::catch_up`].
    pub(super) async fn lagging(
        &self,
        connection: &Connection,
        remaining: Duration,
        patience: Duration,
    ) -> tonic::Status {
        if self.client().connections().are_several() {
            sleep_until(Instant::now() + SLOW_TIME).await;
            let remaining = remaining.saturating_sub(SLOW_TIME);
            let waited = self.wait_for_newest(connection, remaining, patience).await;
            // A refusal says nothing about the call: a server that stops still answers the calls that it has taken.
            if let Err(status) = waited
                && status.code() == tonic::Code::Unavailable
                && status.source().is_some()
            {
                return status;
            }
        }
        pending().await
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
