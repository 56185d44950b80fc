//! Reading all points.

use tonic::Streaming;
use wayfold_proto::v1;

use super::{awaitable, into_stream, receive};
use crate::{
    Error, Filter, Include, IndexHandle, Limits, Points, Revision,
    net::{connections::Connection, limits},
};

/// Reads all points at one revision, in the order of their ids; await it to begin.
#[derive(Clone, Debug)]
#[must_use = "a request does nothing until it is awaited"]
pub struct ScanRequest {
    index: IndexHandle,
    filter: Filter,
    include: Include,
    after_id: Option<u64>,
}

/// A scan under way, a stream of parts. The handle's timeout bounds the wait for each part, not the whole.
///
/// The server holds the points of the revision for the scan, for as long as it allows: then the scan ends with
/// `RESOURCE_EXHAUSTED`, and a new one can continue [after](ScanRequest::after_id) the last id, at a newer revision.
#[derive(Debug)]
pub struct Scan {
    index: IndexHandle,
    include: Include,
    parts: Streaming<v1::ScanResponse>,
    /// The part that named the revision and the count.
    first: Option<Points>,
    revision: Revision,
    point_count: u64,
}

awaitable!(ScanRequest => Scan);
into_stream!(Scan => Points);

impl ScanRequest {
    pub(crate) fn new(index: IndexHandle) -> ScanRequest {
        ScanRequest {
            index,
            filter: Filter::default(),
            include: Include::points(),
            after_id: None,
        }
    }

    /// Only some of the points.
    pub fn filter(mut self, filter: Filter) -> ScanRequest {
        self.filter = filter;
        self
    }

    /// The columns of the answer in addition to ids; states, tags and revisions unless set.
    pub fn include(mut self, include: Include) -> ScanRequest {
        self.include = include;
        self
    }

    /// Only points with ids above this one.
    pub fn after_id(mut self, id: u64) -> ScanRequest {
        self.after_id = Some(id);
        self
    }

    async fn send(self) -> Result<Scan, Error> {
        let ScanRequest { index, include, .. } = &self;
        let open = |connection: Connection| {
            let message = self.message();
            async move { connection.points().scan(message).await }
        };
        let mut parts = index
            .open_stream(CALL, self.filter.since.as_ref(), open)
            .await?;
        let Some(first) = receive(CALL, index, &mut parts).await? else {
            return Err(Error::protocol(CALL, "a scan without any part"));
        };
        let (revision, point_count) = (index.answered(CALL, first.revision)?, first.point_count);
        let width = index.coordinates();
        let first =
            Points::from_message(CALL, first.points, revision.clone(), width, self.include)?;
        Ok(Scan {
            parts,
            first: Some(first),
            revision,
            point_count,
            include: *include,
            index: self.index,
        })
    }

    fn message(&self) -> v1::ScanRequest {
        let index = &self.index;
        // The size of payloads is not known before the call.
        let row_bytes = self.include.neighbor_bytes(index.coordinates());
        let rows = limits::rows_of_answer(index.client(), &Limits::NONE, row_bytes);
        v1::ScanRequest {
            index_name: self.index.name().to_owned(),
            filter: self.filter.to_message(),
            include: self.include.to_message(),
            after_id: self.after_id,
            min_revision: self.index.min_revision(),
            latest: self.index.reads_latest(),
            page_size: u32::try_from(rows).unwrap_or(u32::MAX),
            ..Default::default()
        }
    }
}

const CALL: &str = "scan";

impl Scan {
    /// The revision that is read.
    pub fn revision(&self) -> &Revision {
        &self.revision
    }

    /// The number of points of the index at this revision, before the filter.
    pub fn point_count(&self) -> u64 {
        self.point_count
    }

    /// The next points; `None` at the end. A part may be empty.
    ///
    /// # Errors
    /// Those of every call; the scan is then over.
    pub async fn next(&mut self) -> Result<Option<Points>, Error> {
        if let Some(first) = self.first.take() {
            return Ok(Some(first));
        }
        let Some(part) = receive(CALL, &self.index, &mut self.parts).await? else {
            return Ok(None);
        };
        let (revision, width) = (self.revision.clone(), self.index.coordinates());
        Points::from_message(CALL, part.points, revision, width, self.include).map(Some)
    }
}
