//! Answers in columns; an answer fails as soon as it exceeds its limit.

use bytes::Bytes;
use prost::encoding::encoded_len_varint;
use wayfold_index::{Neighbor, Point, PointRef};
use wayfold_proto::v1;

use super::{Call, Error, Limits};
use crate::admission::AnswerBytes;

/// Bytes reserved for the fixed fields, and for the tags and lengths of columns.
const FRAME_BYTES: usize = 256;

/// The bytes left of an answer, and those that it holds. They are counted from above: an answer that fits here fits on the wire.
pub(super) struct AnswerBudget {
    limit: usize,
    /// The bytes left.
    pub(super) left: usize,
    pub(super) held: AnswerBytes,
}

impl AnswerBudget {
    pub(super) fn new(limits: &Limits, call: &Call) -> Self {
        Self {
            limit: limits.max_answer_bytes,
            left: limits.max_answer_bytes.saturating_sub(FRAME_BYTES),
            held: call.answer_bytes(),
        }
    }

    /// Takes bytes of the answer, and holds them.
    pub(super) fn take(&mut self, bytes: usize) -> Result<(), Error> {
        self.take_held(bytes)?;
        Ok(self.held.take(bytes)?)
    }

    /// Takes bytes of the answer that the call holds already.
    pub(super) fn take_held(&mut self, bytes: usize) -> Result<(), Error> {
        match self.left.checked_sub(bytes) {
            Some(left) => {
                self.left = left;
                Ok(())
            }
            None => Err(Error::LimitExceeded {
                limit: "max_answer_bytes",
                value: self.limit as u64,
                requested: (self.limit - self.left + bytes) as u64,
                advice: "ask for less in one call: fewer states or ids, a smaller k or radius, fewer columns",
            }),
        }
    }
}

/// The error for a point that the forest holds and the log does not, or the reverse.
pub(super) fn missing(id: u64) -> Error {
    Error::Internal {
        what: format!(
            "the point with id {id} is in the forest and not in the log, or the other way"
        ),
    }
}

/// Columns of neighbours.
pub(super) struct NeighborColumns {
    include: v1::Include,
    width: usize,
    pub(super) budget: AnswerBudget,
    columns: v1::Neighbors,
}

impl NeighborColumns {
    /// Empty columns, for states of `width` coordinates.
    pub(super) fn new(include: Option<v1::Include>, width: usize, budget: AnswerBudget) -> Self {
        let include = include.unwrap_or_default();
        Self {
            columns: v1::Neighbors {
                states: include.with_states.then(v1::States::default),
                ..Default::default()
            },
            include,
            width,
            budget,
        }
    }

    /// The bytes of a neighbour without its revision and payload.
    fn fixed_bytes(&self) -> usize {
        let state = if self.include.with_states {
            8 * self.width
        } else {
            0
        };
        let tag = if self.include.with_tags { 8 } else { 0 };
        8 + 8 + state + tag
    }

    /// A number of neighbours that certainly exceeds the budget: a search need not find more.
    pub(super) fn too_many(&self) -> usize {
        self.budget.left / self.fixed_bytes() + 1
    }

    /// Adds the neighbours of the next state without their payloads. `point` finds the point with an id.
    pub(super) fn push(
        &mut self,
        point: impl Fn(u64) -> Option<Point>,
        neighbors: &[Neighbor],
    ) -> Result<(), Error> {
        self.budget.take(
            encoded_len_varint(neighbors.len() as u64) + neighbors.len() * self.fixed_bytes(),
        )?;
        self.columns.neighbor_counts.push(neighbors.len() as u32);
        for neighbor in neighbors {
            self.columns.ids.push(neighbor.id);
            self.columns.distances.push(neighbor.distance);
            if self.include.with_states || self.include.with_tags || self.include.with_revisions {
                self.push_point(point(neighbor.id).ok_or_else(|| missing(neighbor.id))?)?;
            }
        }
        Ok(())
    }

    /// The ids of added neighbours whose payloads are still missing; empty if the answer has no payloads.
    pub(super) fn without_payload(&self) -> &[u64] {
        match self.include.with_payloads {
            true => &self.columns.ids[self.columns.payloads.len()..],
            false => &[],
        }
    }

    /// Adds the payload of the next neighbour, which the call has held since its read.
    pub(super) fn push_payload(&mut self, payload: Bytes) -> Result<(), Error> {
        self.budget.take_held(payload_bytes(&payload))?;
        self.columns.payloads.push(payload);
        Ok(())
    }

    fn push_point(&mut self, point: Point) -> Result<(), Error> {
        if let Some(states) = &mut self.columns.states {
            states.row_count += 1;
            states.coordinates.extend(point.row);
        }
        if self.include.with_tags {
            self.columns.tags.push(point.tag);
        }
        if self.include.with_revisions {
            self.budget.take(encoded_len_varint(point.revision))?;
            self.columns.revisions.push(point.revision);
        }
        Ok(())
    }

    /// The columns. What they hold is given back: they are encoded next.
    pub(super) fn finish(self) -> v1::Neighbors {
        self.columns
    }

    /// The columns, and what they hold until they are encoded.
    pub(super) fn finish_held(self) -> (v1::Neighbors, AnswerBytes) {
        (self.columns, self.budget.held)
    }
}

/// Columns of points.
pub(super) struct PointColumns {
    include: v1::Include,
    columns: v1::Points,
    bytes: usize,
}

/// The default columns of points.
const POINT_COLUMNS: v1::Include = v1::Include {
    with_states: true,
    with_tags: true,
    with_revisions: true,
    with_payloads: false,
};

impl PointColumns {
    pub(super) fn new(include: Option<v1::Include>) -> Self {
        let include = include.unwrap_or(POINT_COLUMNS);
        Self {
            columns: v1::Points {
                states: include.with_states.then(v1::States::default),
                ..Default::default()
            },
            include,
            bytes: 0,
        }
    }

    /// True if each point is added with its payload.
    pub(super) fn with_payloads(&self) -> bool {
        self.include.with_payloads
    }

    /// Adds a point, either every one with its payload or none.
    pub(super) fn push(&mut self, point: PointRef<'_>, payload: Option<Bytes>) {
        self.bytes += 8;
        self.columns.ids.push(point.id);
        if let Some(states) = &mut self.columns.states {
            self.bytes += 8 * point.row.len();
            states.row_count += 1;
            states.coordinates.extend_from_slice(point.row);
        }
        if self.include.with_tags {
            self.bytes += 8;
            self.columns.tags.push(point.tag);
        }
        if self.include.with_revisions {
            self.bytes += encoded_len_varint(point.revision);
            self.columns.revisions.push(point.revision);
        }
        if let Some(payload) = payload {
            self.bytes += payload_bytes(&payload);
            self.columns.payloads.push(payload);
        }
    }

    pub(super) fn len(&self) -> usize {
        self.columns.ids.len()
    }

    /// The bytes of the points in an answer.
    pub(super) fn bytes(&self) -> usize {
        self.bytes
    }

    pub(super) fn finish(self) -> v1::Points {
        self.columns
    }
}

/// The bytes of a payload in its column, with tag and length.
pub(super) fn payload_bytes(payload: &Bytes) -> usize {
    1 + encoded_len_varint(payload.len() as u64) + payload.len()
}

#[cfg(test)]
mod tests;
