//! Reading all points.

use std::time::Duration;

use futures_util::{Stream, stream};
use tokio::time::timeout;
use tonic::Streaming;
use wayfold_index::Filter;
use wayfold_proto::v1;

use super::awaitable;
use crate::{Error, IndexHandle, Points, read::filter_message};

/// Reads all points at one revision, in the order of their ids; await it to begin.
#[derive(Clone, Debug)]
#[must_use = "a request does nothing until it is awaited"]
pub struct ScanRequest {
    index: IndexHandle,
    filter: Filter,
    payloads: bool,
    after_id: Option<u64>,
}

/// A scan under way. The handle's timeout bounds the wait for each part, not the whole.
///
/// The server holds the points of the revision for the scan, for as long as it allows: then the scan ends with
/// `RESOURCE_EXHAUSTED`, and a new one can go on [after](ScanRequest::after_id) the last id, at a newer revision.
#[derive(Debug)]
pub struct Scan {
    index: IndexHandle,
    payloads: bool,
    parts: Streaming<v1::ScanResponse>,
    /// The part that told the revision and the total.
    first: Option<Points>,
    revision: u64,
    total_points: u64,
}

awaitable!(ScanRequest => Scan);

impl ScanRequest {
    pub(crate) fn new(index: IndexHandle) -> ScanRequest {
        ScanRequest {
            index,
            filter: Filter::default(),
            payloads: false,
            after_id: None,
        }
    }

    /// Only some of the points.
    pub fn filter(mut self, filter: Filter) -> ScanRequest {
        self.filter = filter;
        self
    }

    /// Reads the payloads too.
    pub fn payloads(mut self) -> ScanRequest {
        self.payloads = true;
        self
    }

    /// Only points with ids above this one.
    pub fn after_id(mut self, id: u64) -> ScanRequest {
        self.after_id = Some(id);
        self
    }

    async fn send(self) -> Result<Scan, Error> {
        let (stub, client) = (self.index.client().points(), self.index.client());
        let attempt = |_remaining: Duration| {
            let (mut stub, message) = (stub.clone(), self.message());
            // Without a deadline, which would bound the whole stream.
            async move { stub.scan(message).await }
        };
        let parts = client.call(CALL, self.index.timeout(), attempt).await?;
        let mut scan = Scan {
            parts,
            first: None,
            revision: 0,
            total_points: 0,
            payloads: self.payloads,
            index: self.index,
        };
        let Some(first) = scan.receive().await? else {
            return Err(Error::Protocol {
                call: CALL,
                problem: "a scan without any part".to_owned(),
            });
        };
        (scan.revision, scan.total_points) = (first.revision, first.total_points);
        scan.index.told(&first.uid, first.revision);
        scan.first = Some(scan.points(first)?);
        Ok(scan)
    }

    fn message(&self) -> v1::ScanRequest {
        v1::ScanRequest {
            index: self.index.name().to_owned(),
            filter: filter_message(self.filter),
            payloads: self.payloads,
            after_id: self.after_id,
            at: Some(self.index.read_at()),
        }
    }
}

const CALL: &str = "scan";

impl Scan {
    /// The revision that is read.
    pub fn revision(&self) -> u64 {
        self.revision
    }

    /// How many points the index holds at this revision, before the filter.
    pub fn total_points(&self) -> u64 {
        self.total_points
    }

    /// The next points; `None` at the end. A part may be empty.
    ///
    /// # Errors
    /// Those of every call; the scan is then over.
    pub async fn next_part(&mut self) -> Result<Option<Points>, Error> {
        if let Some(first) = self.first.take() {
            return Ok(Some(first));
        }
        self.receive()
            .await?
            .map(|part| self.points(part))
            .transpose()
    }

    /// The parts from here on as a stream.
    pub fn into_stream(self) -> impl Stream<Item = Result<Points, Error>> + Send {
        stream::try_unfold(self, |mut scan| async move {
            Ok(scan.next_part().await?.map(|part| (part, scan)))
        })
    }

    async fn receive(&mut self) -> Result<Option<v1::ScanResponse>, Error> {
        let waited = self.index.timeout();
        let part = timeout(waited, self.parts.message()).await;
        let part = part.map_err(|_| Error::timeout(CALL, waited))?;
        part.map_err(|status| Error::from_status(CALL, self.index.client().uri(), waited, status))
    }

    fn points(&self, part: v1::ScanResponse) -> Result<Points, Error> {
        Points::from_message(
            CALL,
            part.points,
            part.revision,
            self.index.coordinates(),
            self.payloads,
        )
    }
}
