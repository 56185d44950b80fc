//! `SnapshotIndex`: all of an index at one pinned revision, part by part.

use std::sync::Arc;

use wayfold_proto::{
    snapshot::{Header, Writer},
    v1,
};

use super::{
    Call, Error, Limits, Service,
    check::Violations,
    read_view::{revision_number, uid_of},
    revision_pin::RevisionPin,
    session_pages::SessionPages,
    stored,
};
use crate::{
    identity::Role,
    log::{LogError, StoredPoint, View},
    registry::{Hosted, Published},
};

/// Approximate bytes of a part, less if answers are limited to less. Its checksum is computed without a pause.
const PART_BYTES: usize = 256 * 1024;

/// A page ends with the point by which it has this many bytes, or those that are left of a part.
const MIN_PAGE_BYTES: usize = 64 * 1024;

/// Points read from the log at once.
const PAGE_ROWS: usize = 128;

/// A running snapshot. It pins its revision until it ends, is dropped, or its time is up.
pub struct Snapshot {
    call: Call,
    hosted: Arc<Hosted>,
    pinned_revision: RevisionPin,
    part_bytes: usize,
    writer: Writer,
    after: Option<u64>,
    sessions: SessionPages,
    next: Next,
}

/// The kind of the next part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Next {
    Header,
    Points,
    /// Writer sessions, or the trailer.
    Sessions,
    Nothing,
}

impl Service {
    /// Begins to read all of an index at one pinned revision.
    pub async fn snapshot_index(
        &self,
        call: &Call,
        request: v1::SnapshotIndexRequest,
    ) -> Result<Snapshot, Error> {
        let uid = uid_of(request.min_revision.as_ref());
        let hosted = self.index(call, Role::Read, &request.index_name, uid)?;
        let mut violations = Violations::default();
        let min = request.min_revision.as_ref();
        let min = revision_number(&hosted, "min_revision", min, &mut violations)?;
        violations.finish()?;

        let published = self.published(call, &hosted, min, false).await?;
        Ok(Snapshot::of(self.limits(), call.clone(), hosted, published))
    }
}

impl Snapshot {
    /// A snapshot of a published revision, which it pins from now on.
    pub(super) fn of(
        limits: &Limits,
        call: Call,
        hosted: Arc<Hosted>,
        published: Arc<Published>,
    ) -> Self {
        Self {
            call,
            hosted,
            pinned_revision: RevisionPin::new(published, limits.max_scan_seconds),
            part_bytes: PART_BYTES.min(limits.max_answer_bytes / 2),
            writer: Writer::new(),
            after: None,
            sessions: SessionPages::default(),
            next: Next::Header,
        }
    }

    /// The uid of the index, and the pinned revision.
    pub(crate) fn content(&self) -> Result<(&str, u64), Error> {
        Ok((self.hosted.uid_text(), self.published()?.revision))
    }

    /// The most bytes that it takes to make the next part, if there is one: its columns grow by doubling.
    pub(crate) fn next_bytes(&self) -> usize {
        match self.next {
            Next::Nothing => 0,
            _ => 2 * self.part_bytes,
        }
    }

    /// The next part as a message; None after the trailer or an error.
    pub async fn next(&mut self) -> Option<Result<v1::SnapshotIndexResponse, Error>> {
        let part = self.next_part().await?;
        Some(part.map(|part| v1::SnapshotIndexResponse { part: Some(part) }))
    }

    /// The next part; None after the trailer or an error.
    pub(super) async fn next_part(&mut self) -> Option<Result<v1::SnapshotPart, Error>> {
        let part = match self.next {
            Next::Header => self.header(),
            Next::Points => self.points().await,
            Next::Sessions => self.sessions(),
            Next::Nothing => return None,
        };
        if part.is_err() {
            self.next = Next::Nothing;
        }
        if self.next == Next::Nothing {
            self.pinned_revision.release();
        }
        Some(part)
    }

    fn header(&mut self) -> Result<v1::SnapshotPart, Error> {
        let published = self.published()?;
        self.next = Next::Points;
        Ok(self.writer.header(&Header {
            name: self.hosted.name().into(),
            uid: self.hosted.uid_text().into(),
            space: self.hosted.space().clone(),
            payload_encoding: self.hosted.payload_encoding(),
            revision: published.revision,
            next_id: published.view.next_id(),
            point_count: published.snapshot.len() as u64,
        }))
    }

    /// The next points, or what follows them.
    async fn points(&mut self) -> Result<v1::SnapshotPart, Error> {
        let published = self.published()?;
        let index = self.hosted.name();
        let (after, most) = (self.after, self.part_bytes);
        let read = move |view: &dyn View| Rows::read(view, after, most);
        let read = stored::read(
            &self.call,
            "while taking a snapshot",
            index,
            &published,
            read,
        );
        let (rows, after) = read.await?;
        self.published()?;
        self.after = after;
        if let Some(points) = rows.finish() {
            return Ok(self.writer.points(points));
        }
        let (stored, searched) = (
            self.writer.points_written(),
            published.snapshot.len() as u64,
        );
        if stored != searched {
            let (index, revision) = (self.hosted.name(), published.revision);
            return Err(Error::DataLoss {
                what: format!(
                    "index \"{index}\": at revision {revision} it has {searched} points, of which {stored} are stored"
                ),
            });
        }
        self.next = Next::Sessions;
        self.sessions()
    }

    /// The next writer sessions and blocks of reserved ids, or the trailer.
    fn sessions(&mut self) -> Result<v1::SnapshotPart, Error> {
        let published = self.published()?;
        let page = self
            .sessions
            .next(published.view.sessions(), self.part_bytes);
        Ok(match page {
            Some(sessions) => self.writer.sessions(sessions),
            None => {
                self.next = Next::Nothing;
                self.writer.trailer()
            }
        })
    }

    fn published(&self) -> Result<Arc<Published>, Error> {
        self.pinned_revision.get().ok_or(Error::HeldTooLong {
            what: "snapshot",
            max_scan_seconds: self.pinned_revision.seconds,
        })
    }
}

/// Columns of stored points.
#[derive(Default)]
struct Rows {
    points: v1::Points,
    states: v1::States,
    modified: Vec<u64>,
    bytes: usize,
}

impl Rows {
    /// Reads stored points after an id, up to `most` bytes; returns them with the id of the last.
    fn read(
        view: &dyn View,
        mut after: Option<u64>,
        most: usize,
    ) -> Result<(Self, Option<u64>), LogError> {
        let mut rows = Self::default();
        while rows.bytes < most {
            // The first point of a page costs more than the others.
            let page =
                view.page_within(after, PAGE_ROWS, (most - rows.bytes).max(MIN_PAGE_BYTES))?;
            if page.is_empty() {
                break;
            }
            for point in &page {
                rows.push(point);
                after = Some(point.id);
                if rows.bytes >= most {
                    break;
                }
            }
        }
        Ok((rows, after))
    }

    fn push(&mut self, point: &StoredPoint) {
        self.bytes += 8 * (point.state.len() + 4) + point.payload.len();
        let points = &mut self.points;
        points.ids.push(point.id);
        points.tags.push(point.tag);
        points.revisions.push(point.revision);
        points.payloads.push(point.payload.clone());
        self.modified.push(point.modified);
        self.states.row_count += 1;
        self.states.coordinates.extend_from_slice(&point.state);
    }

    /// The next part; `None` if it has no points.
    fn finish(mut self) -> Option<v1::SnapshotPoints> {
        if self.modified.is_empty() {
            return None;
        }
        if self
            .points
            .payloads
            .iter()
            .all(|payload| payload.is_empty())
        {
            self.points.payloads.clear();
        }
        self.points.states = Some(self.states);
        Some(v1::SnapshotPoints {
            points: Some(self.points),
            modified_revisions: self.modified,
        })
    }
}
