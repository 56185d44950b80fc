//! The calls that a shared index makes.

use std::time::Duration;

use wayfold_index::{Forest, ForestOptions, PointRef, Points, Space};
use wayfold_proto::v1;

#[cfg(feature = "zenoh")]
use super::publications::Publications;
use crate::{
    Client, Code, Error, Include, IndexHandle, Revision, Watch, net::request::fresh_operation_id,
};

/// The time without a publication after which the index's log is read: the last one may be lost.
#[cfg(feature = "zenoh")]
const QUIET_TIME: Duration = Duration::from_secs(1);

/// The way to the server, and the name of the index.
#[derive(Clone, Debug)]
pub(super) struct Link {
    client: Client,
    name: String,
    #[cfg(feature = "zenoh")]
    publications: Option<Publications>,
}

/// A session and the ids that were reserved with it.
pub(super) struct Session {
    pub(super) session: u64,
    pub(super) reserved: Option<v1::IdBlock>,
}

impl Link {
    /// Connects, and opens the index; with a space it is created if it is missing.
    pub(super) async fn open(
        uri: &str,
        name: &str,
        timeout: Duration,
        create: Option<&Space>,
    ) -> Result<(Link, IndexHandle), Error> {
        let client = Client::builder().timeout(timeout).connect(uri).await?;
        let index = match create {
            Some(space) => client.create_index(name, space).await?,
            None => client.index(name).await?,
        };
        let link = Link {
            client,
            name: name.to_owned(),
            #[cfg(feature = "zenoh")]
            publications: None,
        };
        Ok((link, index))
    }

    /// Follows the index's publications over Zenoh instead of the server's feed.
    #[cfg(feature = "zenoh")]
    pub(super) fn follow_over(&mut self, publications: Publications) {
        self.publications = Some(publications);
    }

    /// The pause after this many failures in a row.
    pub(super) fn pause(&self, failures: u32) -> Duration {
        self.client.retry_policy().endless_pause(failures)
    }

    /// The index that has the name now.
    pub(super) async fn index(&self) -> Result<IndexHandle, Error> {
        self.client.index(&self.name).await
    }

    /// The most rows, and the most bytes, of one request.
    pub(super) async fn limits(&self, timeout: Duration) -> Result<(usize, usize), Error> {
        let limits = self.client.limits("shared", timeout).await?;
        Ok((limits.max_rows_per_call, limits.max_request_bytes))
    }

    /// Opens a writer session.
    pub(super) async fn open_session(
        &self,
        index: &IndexHandle,
        reserve_count: u64,
    ) -> Result<Session, Error> {
        const CALL: &str = "open_session";
        // A repeated call gets the same session.
        let operation_id = fresh_operation_id();
        let message = || v1::OpenSessionRequest {
            index_name: index.name().to_owned(),
            uid: index.uid().to_owned(),
            reserve_count,
            operation_id: operation_id.clone(),
        };
        let send = |mut stub: Stub, request| async move { stub.open_session(request).await };
        let answer = index.call(CALL, message, send).await?;
        index.answered(CALL, answer.revision)?;
        Ok(Session {
            session: answer.session,
            reserved: answer.reserved,
        })
    }

    /// Writes a batch. Returns the ids it reserved and the number of the revision it made.
    pub(super) async fn write(
        &self,
        index: &IndexHandle,
        request: v1::WriteRequest,
    ) -> Result<(Option<v1::IdBlock>, u64), Error> {
        const CALL: &str = "write";
        let send = |mut stub: Stub, request| async move { stub.write(request).await };
        let answer = index.call(CALL, || request.clone(), send).await?;
        let revision = index.answered(CALL, answer.revision)?;
        Ok((answer.reserved, revision.number))
    }

    /// Watches the index after a revision, without the points that `own_session` stores.
    pub(super) async fn watch(
        &self,
        index: &IndexHandle,
        after: Revision,
        own_session: u64,
    ) -> Result<Watch, Error> {
        #[cfg(feature = "zenoh")]
        if let Some(publications) = &self.publications {
            return publications.watch(index, after, QUIET_TIME).await;
        }
        index.watch().after(after).own_session(own_session).await
    }

    /// All points of the index and their revision. The changes of the forest are `at`.
    pub(super) async fn load(&self, index: &IndexHandle, at: u64) -> Result<(Forest, u64), Error> {
        let columns = Include::none().states().tags();
        let mut scan = index.scan().include(columns).await?;
        let (revision, total) = (scan.revision().number, scan.point_count());
        let mut points = Points::new(index.coordinates());
        while let Some(part) = scan.next().await? {
            for point in part.iter() {
                points.push_point(PointRef {
                    id: point.id,
                    tag: point.tag,
                    revision: at,
                    row: point.state,
                });
            }
        }
        if points.len() as u64 != total {
            let found = points.len();
            return Err(protocol(format!(
                "a scan of {found} points that announced {total}"
            )));
        }
        let space = index.space().clone();
        let building = tokio::task::spawn_blocking(move || build(&space, points, at));
        let built = building.await;
        let forest =
            built.map_err(|error| protocol(format!("its points cannot be built: {error}")))?;
        Ok((forest?, revision))
    }
}

/// A forest of the points, without anything left to merge.
fn build(space: &Space, points: Points, at: u64) -> Result<Forest, Error> {
    let mut forest = Forest::new(space.clone(), ForestOptions::for_space(space));
    let applied = forest.apply(at, &points, &[]);
    applied.map_err(|error| protocol(error.to_string()))?;
    drop(points);
    forest.settle();
    Ok(forest)
}

type Stub = wayfold_proto::v1::point_service_client::PointServiceClient<tonic::transport::Channel>;

/// True if the same call may succeed later: the server is away, slow or overloaded, and says nothing about the call.
pub(super) fn is_transient(error: &Error) -> bool {
    match error {
        Error::Connection { .. } | Error::Timeout { .. } => true,
        Error::Refused(refusal) => {
            matches!(refusal.code, Code::Unavailable | Code::DeadlineExceeded)
                || refusal.retry_after.is_some()
        }
        _ => false,
    }
}

pub(super) fn protocol(problem: String) -> Error {
    Error::Protocol {
        call: "shared",
        problem,
    }
}
