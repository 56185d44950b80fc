//! Making an index of a snapshot.

use std::{pin::Pin, time::Duration};

use futures_util::{Stream, StreamExt, stream};
use tokio::{
    sync::{oneshot, watch},
    time::timeout,
};
use tonic::Code;
use wayfold_proto::v1;

use crate::{Client, Error, IndexHandle, IndexInfo, SnapshotPart};

const CALL: &str = "restore_index";

/// Time per point that the client adds to the timeout after the last part, while the server builds the index.
const BUILDING: Duration = Duration::from_micros(100);

type Parts = Pin<Box<dyn Stream<Item = Result<SnapshotPart, Error>> + Send>>;

impl Client {
    /// Makes an index of a snapshot, under a name that no index has yet: with the same points, ids, tags, payloads and
    /// revisions, and a uid of its own. The parts are those of a [`Snapshot`](crate::Snapshot) of another server, or of
    /// a file ([`SnapshotReader`](crate::SnapshotReader)).
    ///
    /// The timeout bounds the wait for the server to take each part, and at the end, with 100 µs more for each point,
    /// the wait for it to build the index. It is not retried. After an error nothing is left, except that the index may
    /// be there, and then is whole, after [`Error::Timeout`], [`Error::Connection`], and the refusals after which the
    /// outcome of a mutation is [unknown](Error::Refused).
    ///
    /// # Errors
    /// `ALREADY_EXISTS`: an index has this name. `INVALID_ARGUMENT`: the name, or the snapshot. `RESOURCE_EXHAUSTED`:
    /// as for [`Client::create_index`], or the snapshot exceeds a limit of the server. Or the first error of `parts`.
    pub async fn restore<S>(&self, name: &str, parts: S) -> Result<IndexHandle, Error>
    where
        S: Stream<Item = Result<SnapshotPart, Error>> + Send + 'static,
    {
        // Waits for a server that is still starting, which a call that sends a stream cannot do.
        match self.index_info(name).await {
            Err(error) if error.code() != Code::NotFound => return Err(error),
            _ => {}
        }
        let (failed, failure) = oneshot::channel();
        let (moved, mut movement) = watch::channel(Movement::default());
        let source = Source {
            parts: parts.fuse().boxed(),
            held: None,
            name: name.to_owned(),
            failed: Some(failed),
            moved,
        };
        let connection = self.connection();
        let mut stub = connection.indexes();
        let restored = stub.restore_index(stream::unfold(source, Source::next));
        tokio::select! {
            biased;
            Ok(error) = failure => Err(error),
            restored = restored => {
                let restored = restored.map_err(|status| {
                    Error::from_status(CALL, connection.uri(), self.timeout(), status)
                })?;
                let info = IndexInfo::from_message(CALL, restored.into_inner().index)?;
                Ok(IndexHandle::new(self.clone(), info))
            }
            timeout = stalled(&mut movement, self.timeout()) => {
                Err(Error::timeout(CALL, timeout))
            }
        }
    }
}

/// The progress of the sending.
#[derive(Clone, Copy, Debug, Default)]
struct Movement {
    /// True while the client waits for the server, and not for the next part.
    servers: bool,
    /// True once the last part was given.
    done: bool,
    points: u32,
}

/// Returns, with how long it waited, once the server has not moved for too long.
async fn stalled(movement: &mut watch::Receiver<Movement>, patience: Duration) -> Duration {
    loop {
        let now = *movement.borrow_and_update();
        let building = if now.done {
            BUILDING.saturating_mul(now.points)
        } else {
            Duration::ZERO
        };
        let patience = patience.saturating_add(building);
        let changed = movement.changed();
        if !now.servers && !now.done {
            // The sender is gone only where the call has ended, and the call's own future ends then.
            if changed.await.is_err() {
                std::future::pending::<()>().await;
            }
            continue;
        }
        match timeout(patience, changed).await {
            Ok(Ok(())) => {}
            // Nothing more is sent; the answer is to come.
            Ok(Err(_)) if now.done => {
                tokio::time::sleep_until(tokio::time::Instant::now() + patience).await;
                return patience;
            }
            Ok(Err(_)) => std::future::pending().await,
            Err(_) => return patience,
        }
    }
}

/// The messages to send.
struct Source {
    parts: Parts,
    /// The part to send once another follows or the file ends: the last one makes the snapshot whole, so it is not
    /// sent if a damaged part follows.
    held: Option<SnapshotPart>,
    /// Empty once it was sent.
    name: String,
    failed: Option<oneshot::Sender<Error>>,
    moved: watch::Sender<Movement>,
}

impl Source {
    async fn next(mut self) -> Option<(v1::RestoreIndexRequest, Source)> {
        self.moved.send_modify(|movement| movement.servers = false);
        let part = loop {
            match self.parts.next().await {
                Some(Ok(part)) => {
                    if let Some(before) = self.held.replace(part) {
                        break before;
                    }
                }
                Some(Err(error)) => {
                    if let Some(failed) = self.failed.take() {
                        // The receiver is gone if the restore was dropped.
                        let _ = failed.send(error);
                    }
                    // The call is about to be dropped.
                    return std::future::pending().await;
                }
                None => match self.held.take() {
                    Some(last) => break last,
                    None => {
                        self.moved.send_modify(|movement| movement.done = true);
                        return None;
                    }
                },
            }
        };
        let points = u32::try_from(part.points()).unwrap_or(u32::MAX);
        self.moved.send_modify(|movement| {
            movement.servers = true;
            movement.points = movement.points.saturating_add(points);
        });
        let message = v1::RestoreIndexRequest {
            name: std::mem::take(&mut self.name),
            part: Some(part.into_message()),
        };
        Some((message, self))
    }
}
