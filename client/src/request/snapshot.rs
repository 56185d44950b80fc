//! Taking a snapshot.

use std::time::Duration;

use futures_util::{Stream, stream};
use tokio::time::timeout;
use tonic::Streaming;
use wayfold_proto::{
    snapshot::{Content, Header, Reader},
    v1,
};

use super::awaitable;
use crate::{Error, IndexHandle, SnapshotPart};

/// Reads all of an index at one revision, as a backup or for another server; await it to begin.
#[derive(Clone, Debug)]
#[must_use = "a request does nothing until it is awaited"]
pub struct SnapshotRequest {
    index: IndexHandle,
}

/// A snapshot under way: its parts, each checked as it comes. The handle's timeout bounds the wait for each, not the
/// whole.
///
/// It is whole only if the last part was read without an error. [`SnapshotWriter`](crate::SnapshotWriter) writes it
/// into a file; [`Client::restore`](crate::Client::restore) makes an index of it, on this server or another:
///
/// ```no_run
/// # async fn example() -> Result<(), wayfold::Error> {
/// use wayfold::Client;
///
/// let (from, to) = (Client::connect("one:50051").await?, Client::connect("other:50051").await?);
/// let snapshot = from.index("arm").await?.snapshot().await?;
/// let copy = to.restore("arm", snapshot.into_stream()).await?;
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct Snapshot {
    index: IndexHandle,
    parts: Streaming<v1::SnapshotIndexResponse>,
    reader: Reader,
    header: Header,
    first: Option<SnapshotPart>,
}

awaitable!(SnapshotRequest => Snapshot);

const CALL: &str = "snapshot_index";

impl SnapshotRequest {
    pub(crate) fn new(index: IndexHandle) -> SnapshotRequest {
        SnapshotRequest { index }
    }

    async fn send(self) -> Result<Snapshot, Error> {
        let index = self.index;
        let (stub, client) = (index.client().indexes(), index.client());
        let message = v1::SnapshotIndexRequest {
            name: index.name().to_owned(),
            at: Some(index.read_at()),
        };
        let attempt = |_remaining: Duration| {
            let (mut stub, message) = (stub.clone(), message.clone());
            // Without a deadline, which would bound the whole stream.
            async move { stub.snapshot_index(message).await }
        };
        let mut parts = client.call(CALL, index.timeout(), attempt).await?;
        let mut reader = Reader::new();
        match receive(&index, &mut parts, &mut reader).await? {
            Some((part, Content::Header(header))) => {
                index.told(&header.uid, header.revision);
                Ok(Snapshot {
                    index,
                    parts,
                    reader,
                    header,
                    first: Some(part),
                })
            }
            _ => Err(Error::Protocol {
                call: CALL,
                problem: "a snapshot without a header".to_owned(),
            }),
        }
    }
}

/// The next part, checked; none after the trailer.
async fn receive(
    index: &IndexHandle,
    parts: &mut Streaming<v1::SnapshotIndexResponse>,
    reader: &mut Reader,
) -> Result<Option<(SnapshotPart, Content)>, Error> {
    let waited = index.timeout();
    let response = timeout(waited, parts.message()).await;
    let response = response.map_err(|_| Error::timeout(CALL, waited))?;
    let response = response
        .map_err(|status| Error::from_status(CALL, index.client().uri(), waited, status))?;
    let protocol = |problem: String| Error::Protocol {
        call: CALL,
        problem,
    };
    let Some(response) = response else {
        return reader
            .finish()
            .map(|()| None)
            .map_err(|error| protocol(error.to_string()));
    };
    let part = response.part.unwrap_or_default();
    let content = reader
        .read(&part)
        .map_err(|error| protocol(error.to_string()))?;
    Ok(Some((SnapshotPart::new(part, &content), content)))
}

impl Snapshot {
    /// What is known of it before its points.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// The next part; `None` at the end, once it is whole.
    ///
    /// # Errors
    /// Those of every call; the snapshot is then over, and no good.
    pub async fn next_part(&mut self) -> Result<Option<SnapshotPart>, Error> {
        if let Some(first) = self.first.take() {
            return Ok(Some(first));
        }
        let part = receive(&self.index, &mut self.parts, &mut self.reader).await?;
        Ok(part.map(|(part, _)| part))
    }

    /// The parts from here on as a stream.
    pub fn into_stream(self) -> impl Stream<Item = Result<SnapshotPart, Error>> + Send + 'static {
        stream::try_unfold(self, |mut snapshot| async move {
            Ok(snapshot.next_part().await?.map(|part| (part, snapshot)))
        })
    }
}
