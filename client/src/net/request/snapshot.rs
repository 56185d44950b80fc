//! Taking a snapshot.

use tonic::Streaming;
use wayfold_proto::{
    snapshot::{Content, Header, Reader},
    v1,
};

use super::{awaitable, into_stream};
use crate::{
    Error, IndexHandle, Revision, SnapshotError, SnapshotPart, net::connections::Connection,
};

/// Reads all of an index at one revision, as a backup or for another server; await it to begin.
#[derive(Clone, Debug)]
#[must_use = "a request does nothing until it is awaited"]
pub struct SnapshotRequest {
    index: IndexHandle,
}

/// A snapshot under way, a stream of parts, each checked as it comes. The handle's timeout bounds the wait for each,
/// not the whole.
///
/// The snapshot is whole only if the stream ends without an error. [`SnapshotWriter`](crate::SnapshotWriter) writes it
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
into_stream!(Snapshot => SnapshotPart);

const CALL: &str = "snapshot_index";

impl SnapshotRequest {
    pub(crate) fn new(index: IndexHandle) -> SnapshotRequest {
        SnapshotRequest { index }
    }

    async fn send(self) -> Result<Snapshot, Error> {
        let index = self.index;
        let message = v1::SnapshotIndexRequest {
            index_name: index.name().to_owned(),
            min_revision: index.min_revision(),
        };
        let open = |connection: Connection| {
            let message = message.clone();
            async move { connection.indexes().snapshot_index(message).await }
        };
        let mut parts = index.open_stream(CALL, None, open).await?;
        let mut reader = Reader::new();
        match receive(&index, &mut parts, &mut reader).await? {
            Some((part, Content::Header(header))) => {
                index.note(&Revision::new(&*header.uid, header.revision));
                Ok(Snapshot {
                    index,
                    parts,
                    reader,
                    header,
                    first: Some(part),
                })
            }
            _ => Err(Error::protocol(CALL, "a snapshot without a header")),
        }
    }
}

/// The next part, checked; none after the trailer.
async fn receive(
    index: &IndexHandle,
    parts: &mut Streaming<v1::SnapshotIndexResponse>,
    reader: &mut Reader,
) -> Result<Option<(SnapshotPart, Content)>, Error> {
    let response = super::receive(CALL, index, parts).await?;
    let damaged = |error: SnapshotError| Error::protocol(CALL, error.to_string());
    let Some(response) = response else {
        return reader.finish().map(|()| None).map_err(damaged);
    };
    let part = response.part.unwrap_or_default();
    let content = reader.read(&part).map_err(damaged)?;
    Ok(Some((SnapshotPart::new(part, &content), content)))
}

impl Snapshot {
    /// The header, which the snapshot holds before its points.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// The next part; `None` at the end, once it is whole.
    ///
    /// # Errors
    /// Those of every call; the snapshot is then over, and not whole.
    pub async fn next(&mut self) -> Result<Option<SnapshotPart>, Error> {
        if let Some(first) = self.first.take() {
            return Ok(Some(first));
        }
        let part = receive(&self.index, &mut self.parts, &mut self.reader).await?;
        Ok(part.map(|(part, _)| part))
    }
}
