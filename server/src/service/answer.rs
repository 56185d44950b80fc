//! Answers in columns, given up as soon as they would outgrow their limit.

use bytes::Bytes;
use prost::encoding::encoded_len_varint;
use wayfold_index::{Neighbor, Point, Search};
use wayfold_proto::v1;

use super::{Error, Limits, at::log_failed, call::Pace, check::Rows};
use crate::registry::Published;

/// Room for what is in every answer, and for the tags and lengths of its columns.
const FRAME: usize = 256;

/// The bytes an answer may still take. Counted from above, so that what fits here fits on the wire.
pub(super) struct Room {
    limit: usize,
    left: usize,
}

impl Room {
    pub(super) fn new(limits: &Limits) -> Self {
        Self {
            limit: limits.answer_bytes,
            left: limits.answer_bytes.saturating_sub(FRAME),
        }
    }

    pub(super) fn take(&mut self, bytes: usize) -> Result<(), Error> {
        match self.left.checked_sub(bytes) {
            Some(left) => {
                self.left = left;
                Ok(())
            }
            None => Err(Error::LimitExceeded {
                limit: "answer_bytes",
                value: self.limit as u64,
                asked: (self.limit - self.left + bytes) as u64,
                advice: "ask for less in one call: fewer states or ids, a smaller k or radius, fewer columns",
            }),
        }
    }
}

/// Where the columns of an answer come from.
pub(super) trait Source {
    /// The point with this id.
    fn point(&self, id: u64) -> Option<Point>;
    /// Its payload.
    fn payload(&self, id: u64) -> Result<Bytes, Error>;
}

/// A published revision of the index of this name.
pub(super) struct Seen<'a> {
    pub(super) index: &'a str,
    pub(super) published: &'a Published,
}

impl Source for Seen<'_> {
    fn point(&self, id: u64) -> Option<Point> {
        self.published.snapshot.get(id)
    }

    fn payload(&self, id: u64) -> Result<Bytes, Error> {
        match self.published.view.get(id) {
            Ok(Some(point)) => Ok(point.payload.clone()),
            Ok(None) => Err(missing(id)),
            Err(error) => Err(log_failed(self.index, error)),
        }
    }
}

fn missing(id: u64) -> Error {
    Error::Internal {
        what: format!(
            "the point with id {id} is in the forest and not in the log, or the other way"
        ),
    }
}

/// Neighbours under way to their columns.
pub(super) struct Found {
    include: v1::Include,
    width: usize,
    room: Room,
    columns: v1::Neighbors,
}

impl Found {
    /// Of states of `width` coordinates.
    pub(super) fn new(include: Option<v1::Include>, width: usize, room: Room) -> Self {
        let include = include.unwrap_or_default();
        Self {
            columns: v1::Neighbors {
                states: include.states.then(v1::States::default),
                ..Default::default()
            },
            include,
            width,
            room,
        }
    }

    /// What a neighbour takes, without its revision and its payload.
    fn fixed_bytes(&self) -> usize {
        let state = if self.include.states {
            8 * self.width
        } else {
            0
        };
        let tag = if self.include.tags { 8 } else { 0 };
        8 + 8 + state + tag
    }

    /// So many neighbours certainly do not fit any more: a search need not look for more.
    pub(super) fn too_many(&self) -> usize {
        self.room.left / self.fixed_bytes() + 1
    }

    /// Adds the neighbours of the next state.
    pub(super) fn push(
        &mut self,
        source: &impl Source,
        neighbors: &[Neighbor],
    ) -> Result<(), Error> {
        self.room.take(
            encoded_len_varint(neighbors.len() as u64) + neighbors.len() * self.fixed_bytes(),
        )?;
        self.columns.counts.push(neighbors.len() as u32);
        for neighbor in neighbors {
            self.columns.ids.push(neighbor.id);
            self.columns.distances.push(neighbor.distance);
            if self.include.states || self.include.tags || self.include.revisions {
                self.push_point(
                    source
                        .point(neighbor.id)
                        .ok_or_else(|| missing(neighbor.id))?,
                )?;
            }
            if self.include.payloads {
                let payload = source.payload(neighbor.id)?;
                self.room.take(payload_bytes(&payload))?;
                self.columns.payloads.push(payload);
            }
        }
        Ok(())
    }

    fn push_point(&mut self, point: Point) -> Result<(), Error> {
        if let Some(states) = &mut self.columns.states {
            states.rows += 1;
            states.coordinates.extend(point.row);
        }
        if self.include.tags {
            self.columns.tags.push(point.tag);
        }
        if self.include.revisions {
            self.room.take(encoded_len_varint(point.revision))?;
            self.columns.revisions.push(point.revision);
        }
        Ok(())
    }

    pub(super) fn finish(self) -> v1::Neighbors {
        self.columns
    }
}

/// Searches for every state; says also whether all of it is exact.
pub(super) async fn search(
    seen: &Seen<'_>,
    states: &Rows,
    search: Search<'_>,
    mut found: Found,
    pace: &mut Pace,
) -> Result<(v1::Neighbors, bool), Error> {
    let mut exact = true;
    for state in states.iter() {
        let search = Search {
            k: search.k.min(found.too_many()),
            ..search
        };
        let answer = seen.published.snapshot.search(state, &search)?;
        if !answer.exact {
            // Perhaps only because it was out of time.
            pace.check()?;
        }
        exact &= answer.exact;
        found.push(seen, &answer.neighbors)?;
        pace.step().await?;
    }
    Ok((found.finish(), exact))
}

/// Points under way to their columns.
pub(super) struct PointColumns {
    with_payloads: bool,
    columns: v1::Points,
    states: v1::States,
    bytes: usize,
}

impl PointColumns {
    pub(super) fn new(with_payloads: bool) -> Self {
        Self {
            with_payloads,
            columns: v1::Points::default(),
            states: v1::States::default(),
            bytes: 0,
        }
    }

    pub(super) fn push(&mut self, source: &impl Source, point: Point) -> Result<(), Error> {
        self.bytes += 8 + 8 + 8 * point.row.len() + encoded_len_varint(point.revision);
        self.columns.ids.push(point.id);
        self.columns.tags.push(point.tag);
        self.columns.revisions.push(point.revision);
        self.states.rows += 1;
        self.states.coordinates.extend(point.row);
        if self.with_payloads {
            let payload = source.payload(point.id)?;
            self.bytes += payload_bytes(&payload);
            self.columns.payloads.push(payload);
        }
        Ok(())
    }

    pub(super) fn len(&self) -> usize {
        self.columns.ids.len()
    }

    /// How much of an answer the points take.
    pub(super) fn bytes(&self) -> usize {
        self.bytes
    }

    pub(super) fn finish(self) -> v1::Points {
        v1::Points {
            states: Some(self.states),
            ..self.columns
        }
    }
}

/// A payload in its column: the tag and the length too.
fn payload_bytes(payload: &Bytes) -> usize {
    1 + encoded_len_varint(payload.len() as u64) + payload.len()
}
