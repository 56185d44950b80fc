//! Snapshots outside of servers: their parts, and files of them.

use std::io::{self, Read, Write};

use futures_util::{Stream, stream};
use tokio::sync::mpsc;
use wayfold_proto::{
    snapshot::{Content, FileReader, FileWriter, Header, SnapshotError},
    v1,
};

use crate::Error;

/// A checked part of a snapshot.
#[derive(Clone, Debug, PartialEq)]
pub struct SnapshotPart {
    message: v1::SnapshotPart,
    points: usize,
}

impl SnapshotPart {
    pub(crate) fn new(message: v1::SnapshotPart, content: &Content) -> SnapshotPart {
        let points = match content {
            Content::Points(points, _) => points.ids.len(),
            Content::Header(_) | Content::Sessions(_) | Content::Trailer => 0,
        };
        SnapshotPart { message, points }
    }

    /// The number of its points; the first part, the last, and parts of writer sessions hold none.
    pub fn points(&self) -> usize {
        self.points
    }

    pub(crate) fn into_message(self) -> v1::SnapshotPart {
        self.message
    }
}

/// Writes a snapshot into a file or another writer.
///
/// ```no_run
/// use std::fs::File;
/// use wayfold::{Client, SnapshotWriter};
///
/// # async fn example() -> Result<(), Box<dyn std::error::Error>> {
/// let client = Client::connect("http://127.0.0.1:50051").await?;
/// let mut snapshot = client.index("arm").await?.snapshot().await?;
/// let mut file = SnapshotWriter::new(File::create("arm.snapshot")?);
/// while let Some(part) = snapshot.next().await? {
///     file.write(&part)?;
/// }
/// file.finish()?.sync_all()?;
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct SnapshotWriter<W>(FileWriter<W>);

impl<W: Write> SnapshotWriter<W> {
    /// Begins the file. Nothing is written before the first part.
    pub fn new(file: W) -> SnapshotWriter<W> {
        SnapshotWriter(FileWriter::new(file))
    }

    /// Writes the next part.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn write(&mut self, part: &SnapshotPart) -> io::Result<()> {
        self.0.write(&part.message)
    }

    /// Flushes the file, and gives it back.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn finish(self) -> io::Result<W> {
        self.0.finish()
    }
}

/// Reads a snapshot from a file, and checks it: an iterator of its parts. The snapshot is whole only if the iterator
/// ends without an error.
///
/// ```no_run
/// use std::fs::File;
/// use wayfold::{Client, SnapshotReader};
///
/// # async fn example() -> Result<(), Box<dyn std::error::Error>> {
/// let client = Client::connect("http://127.0.0.1:50051").await?;
/// let file = SnapshotReader::new(File::open("arm.snapshot")?)?;
/// println!("{} points in {}", file.header().point_count, file.header().space);
/// let restored = client.restore("arm", file.into_stream()).await?;
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct SnapshotReader<R> {
    file: FileReader<R>,
    header: Header,
    first: Option<SnapshotPart>,
    ended: bool,
}

impl<R: Read> SnapshotReader<R> {
    /// Begins to read.
    ///
    /// # Errors
    /// It is no snapshot, or of an unknown version, or cannot be read.
    pub fn new(file: R) -> Result<SnapshotReader<R>, SnapshotError> {
        let mut file = FileReader::new(file)?;
        match file.next_part()? {
            Some((message, Content::Header(header))) => Ok(SnapshotReader {
                file,
                header,
                first: Some(SnapshotPart { message, points: 0 }),
                ended: false,
            }),
            _ => Err(SnapshotError::CutShort { parts: 0 }),
        }
    }

    /// The header, which the snapshot holds before its points.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// The parts, read on a thread of their own, for [`Client::restore`](crate::Client::restore).
    ///
    /// # Panics
    /// Outside of a Tokio runtime.
    pub fn into_stream(self) -> impl Stream<Item = Result<SnapshotPart, Error>> + Send + 'static
    where
        R: Send + 'static,
    {
        // At most four parts wait to be sent.
        let (sender, receiver) = mpsc::channel(4);
        tokio::task::spawn_blocking(move || {
            for part in self {
                // The restore is over.
                if sender.blocking_send(part.map_err(Error::Snapshot)).is_err() {
                    return;
                }
            }
        });
        stream::unfold(receiver, |mut receiver| async {
            Some((receiver.recv().await?, receiver))
        })
    }
}

impl<R: Read> Iterator for SnapshotReader<R> {
    type Item = Result<SnapshotPart, SnapshotError>;

    fn next(&mut self) -> Option<Self::Item> {
        if let Some(first) = self.first.take() {
            return Some(Ok(first));
        }
        if self.ended {
            return None;
        }
        let next = self.file.next_part().transpose()?;
        self.ended = next.is_err();
        Some(next.map(|(part, content)| SnapshotPart::new(part, &content)))
    }
}
