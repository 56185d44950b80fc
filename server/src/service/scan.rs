//! `Scan`: all points at one pinned revision, part by part.

use std::sync::Arc;

use wayfold_index::Filter;
use wayfold_proto::v1;

use super::{
    Call, Error, Service,
    answer::{PointColumns, payload_bytes},
    check::{self, Violations},
    read_view::{ReadView, revision, revision_number, uid_of},
    revision_pin::RevisionPin,
    stored::BATCH_ROWS,
};
use crate::{
    identity::Role,
    registry::{Hosted, Published},
};

/// Most rows of a part.
const PART_ROWS: usize = 4096;

/// Approximate bytes of a part, less if answers are limited to less.
const PART_BYTES: usize = 1024 * 1024;

const DOING: &str = "while scanning";

/// A running scan. It pins its revision until it ends, is dropped, or its time is up.
pub struct Scan {
    call: Call,
    pub(super) hosted: Arc<Hosted>,
    pub(super) pinned_revision: Arc<RevisionPin>,
    part_rows: usize,
    part_bytes: usize,
    filter: Filter,
    include: Option<v1::Include>,
    after: Option<u64>,
    /// True if there are no further parts.
    pub(super) done: bool,
}

impl Service {
    /// Begins to read all points at one pinned revision, in the order of their ids.
    pub async fn scan(&self, call: &Call, request: v1::ScanRequest) -> Result<Scan, Error> {
        let uid = uid_of(request.min_revision.as_ref());
        let hosted = self.index(call, Role::Read, &request.index_name, uid)?;
        let mut violations = Violations::default();
        let filter = check::filter("filter", request.filter, &hosted, &mut violations)?;
        let min = request.min_revision.as_ref();
        let min = revision_number(&hosted, "min_revision", min, &mut violations)?;
        violations.finish()?;

        let limits = self.limits();
        let min = min.max(filter.since_revision);
        let pinned_revision = if request.held_scan.is_empty() {
            let published = self.published(call, &hosted, min, request.latest).await?;
            Arc::new(RevisionPin::new(published, limits.max_scan_seconds))
        } else {
            self.inner.held_scans.get(&request.held_scan, &hosted)?
        };
        let part_rows = match request.page_size {
            0 => PART_ROWS,
            size => PART_ROWS.min(size as usize),
        };
        Ok(Scan {
            call: call.clone(),
            hosted,
            pinned_revision,
            part_rows,
            part_bytes: PART_BYTES.min(limits.max_answer_bytes / 2),
            filter,
            include: request.include,
            after: request.after_id,
            done: false,
        })
    }
}

impl Scan {
    /// The next part; None after the last or an error. There is at least one. A cancelled call loses no part: the next
    /// call begins where it began.
    pub async fn next(&mut self) -> Option<Result<v1::ScanResponse, Error>> {
        if self.done {
            return None;
        }
        let part = self.part().await;
        self.done |= part.is_err();
        if self.done {
            self.pinned_revision.release();
        }
        Some(part)
    }

    /// The most bytes that it takes to make the next part, if there is one: its columns grow by doubling.
    pub(crate) fn next_bytes(&self) -> usize {
        match self.done {
            true => 0,
            false => 2 * self.part_bytes,
        }
    }

    /// The coordinates of a row.
    pub(crate) fn coordinates(&self) -> usize {
        self.hosted.space().coordinates()
    }

    /// The revision after which the log has every record now.
    pub(crate) fn window_start(&self) -> u64 {
        let newest = self.hosted.published().revision;
        newest.saturating_sub(self.hosted.window().records)
    }

    /// The next part, if it is not done. The revision stays held also after the last part.
    pub(super) async fn part(&mut self) -> Result<v1::ScanResponse, Error> {
        self.call.check(DOING)?;
        let published = self.still_held()?;
        let view = ReadView {
            call: &self.call,
            doing: DOING,
            index: self.hosted.name(),
            published: &published,
        };
        let mut pace = self.call.pace(DOING);
        let mut points = PointColumns::new(self.include);
        // A stream counts its parts itself; a page is an answer of its own.
        let mut held = self.call.answer_bytes();
        let mut after = self.after;
        let mut rest = published
            .snapshot
            .points_after(after)
            .enumerate()
            .peekable();
        let is_full = |points: &PointColumns| {
            points.len() >= self.part_rows || points.bytes() >= self.part_bytes
        };
        while rest.peek().is_some() && !is_full(&points) {
            let (mut batch, mut passed_to) = (Vec::new(), after);
            while batch.len() < BATCH_ROWS
                && let Some((passed, point)) = rest.next()
            {
                passed_to = Some(point.id);
                if self.filter.admits(point.tag, point.revision) {
                    batch.push(point);
                }
                if passed % 32 == 31 {
                    pace.step().await?;
                    self.still_held()?;
                }
            }
            let mut payloads = match points.with_payloads() {
                true => {
                    let ids = batch.iter().map(|point| point.id).collect();
                    let most = self.part_bytes.saturating_sub(points.bytes());
                    let payloads = view.payloads(ids, most, &mut held).await?;
                    self.still_held()?;
                    payloads
                }
                false => Vec::new(),
            }
            .into_iter();
            let mut batch = batch.into_iter().peekable();
            while !is_full(&points)
                && let Some(point) = batch.next()
            {
                after = Some(point.id);
                let payload = payloads.next();
                let before = points.bytes() + payload.as_ref().map_or(0, payload_bytes);
                points.push(point.by_ref(), payload);
                held.take(points.bytes() - before)?;
            }
            if batch.peek().is_some() {
                // The rest begins the next part.
                self.after = after;
                return Ok(self.message(points, &published));
            }
            after = passed_to;
        }
        self.done = rest.peek().is_none();
        self.after = after;
        Ok(self.message(points, &published))
    }

    fn message(&self, points: PointColumns, published: &Published) -> v1::ScanResponse {
        v1::ScanResponse {
            points: Some(points.finish()),
            revision: Some(revision(&self.hosted, published.revision)),
            point_count: published.snapshot.len() as u64,
            held_scan: String::new(),
        }
    }

    fn still_held(&self) -> Result<Arc<Published>, Error> {
        self.pinned_revision.get().ok_or(Error::ScanTooLong {
            max_scan_seconds: self.pinned_revision.seconds,
            after_id: self.after,
        })
    }
}
