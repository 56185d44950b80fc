//! Inserting states.

use bytes::Bytes;
use wayfold_proto::v1;

use super::{
    ID_AND_TAG_BYTES, awaitable, check_column, fresh_operation_id, mutation, payload_bytes,
};
use crate::{
    Error, IndexHandle, Limits, NeighborSpec, Neighbors, Revision, States,
    net::limits::{self, Division},
};

/// Inserts states; await it to send it.
///
/// An insert within the server's [`Limits`] is one call, which is atomic: all of it takes effect, or nothing does. More
/// rows or bytes, or more `neighbors` than an answer holds, are divided among several calls, in order, each atomic of
/// its own; if one fails, [`Error::Partial`] says how many rows took effect before it, and under which ids. The neighbours
/// within a radius are divided once the server has refused them: such an insert is not repeated under its operation id,
/// because its parts may be others.
#[derive(Debug)]
#[must_use = "a request does nothing until it is awaited"]
pub struct Insert {
    index: IndexHandle,
    states: Result<States, Error>,
    ids: Vec<u64>,
    tags: Vec<u64>,
    payloads: Vec<Bytes>,
    replace: bool,
    min_separation: f64,
    neighbors: Option<NeighborSpec>,
    operation_id: String,
}

/// The outcome of one row of an insert.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// Stored as a new point.
    Inserted {
        /// The point's id, given or assigned.
        id: u64,
    },
    /// The same point was stored already.
    Unchanged {
        /// The point's id.
        id: u64,
    },
    /// Stored in the place of another point under the same id.
    Replaced {
        /// The point's id.
        id: u64,
    },
    /// Left out, as a stored point is nearer than `min_separation`.
    TooClose {
        /// The id of the nearest point in its way.
        blocker: u64,
    },
}

impl Outcome {
    /// The id under which the row is stored; `None` if it was left out.
    pub fn id(self) -> Option<u64> {
        match self {
            Outcome::Inserted { id } | Outcome::Unchanged { id } | Outcome::Replaced { id } => {
                Some(id)
            }
            Outcome::TooClose { .. } => None,
        }
    }

    fn from_message(outcome: v1::Outcome, id: u64) -> Option<Outcome> {
        match outcome {
            v1::Outcome::Unspecified => None,
            v1::Outcome::Inserted => Some(Outcome::Inserted { id }),
            v1::Outcome::Unchanged => Some(Outcome::Unchanged { id }),
            v1::Outcome::Replaced => Some(Outcome::Replaced { id }),
            v1::Outcome::TooClose => Some(Outcome::TooClose { blocker: id }),
        }
    }
}

/// The effect of an insert.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Inserted {
    /// The outcome of each row, in order.
    pub outcomes: Vec<Outcome>,
    /// The neighbours of each row, also of those left out, if the insert asked for them.
    pub neighbors: Option<Neighbors>,
    /// The revision that the insert, or the last of its parts, made or found.
    pub revision: Revision,
}

awaitable!(Insert => Inserted);
mutation!(Insert);

const CALL: &str = "insert";

impl Insert {
    pub(crate) fn new(index: IndexHandle, states: Result<States, Error>) -> Insert {
        Insert {
            index,
            states,
            ids: Vec::new(),
            tags: Vec::new(),
            payloads: Vec::new(),
            replace: false,
            min_separation: 0.0,
            neighbors: None,
            operation_id: fresh_operation_id(),
        }
    }

    /// The ids, one a row, below 2⁶³. Without them the server assigns ids, upwards in row order.
    pub fn ids(mut self, ids: impl Into<Vec<u64>>) -> Insert {
        self.ids = ids.into();
        self
    }

    /// The tags, one a row; 0 without them.
    pub fn tags(mut self, tags: impl Into<Vec<u64>>) -> Insert {
        self.tags = tags.into();
        self
    }

    /// The payloads, one a row, of at most 64 KiB; empty for none.
    pub fn payloads<P: Into<Bytes>>(mut self, payloads: impl IntoIterator<Item = P>) -> Insert {
        self.payloads = payloads.into_iter().map(Into::into).collect();
        self
    }

    /// Replaces points that are stored under one of the ids. Unless set, another point there is `ALREADY_EXISTS`.
    pub fn replace(mut self) -> Insert {
        self.replace = true;
        self
    }

    /// Leaves out a row that has a point, stored before or by a row before it, at a distance below this.
    pub fn min_separation(mut self, distance: f64) -> Insert {
        self.min_separation = distance;
        self
    }

    /// Finds the neighbours that each row has when it is applied. The later of any two inserts sees the earlier. The
    /// rows of the same call count as stored by the revision that the call makes.
    pub fn neighbors(mut self, spec: NeighborSpec) -> Insert {
        self.neighbors = Some(spec);
        self
    }

    async fn send(mut self) -> Result<Inserted, Error> {
        let states = std::mem::replace(&mut self.states, Ok(States::new(0)))?;
        let rows = states.len();
        check_column("ids", self.ids.len(), &[0, rows], "states")?;
        check_column("tags", self.tags.len(), &[0, rows], "states")?;
        check_column("payloads", self.payloads.len(), &[0, rows], "states")?;
        let mut inserted = Inserted {
            outcomes: Vec::with_capacity(rows),
            neighbors: None,
            revision: self.index.revision(),
        };
        let division = Division::new(&self.index, rows, &self.ids, &self.operation_id);
        let written = division.write(
            |limits| self.rows_of_answer(limits).min(limits.max_rows_per_call),
            |row| self.row_bytes(&states, row),
            |part, operation_id| self.message(&states, part, operation_id),
            |answer, rows| self.append(answer, rows, &mut inserted),
        );
        match written.await {
            Ok(()) => Ok(inserted),
            Err(mut error) => {
                if let Error::Partial { ids, .. } = &mut error {
                    *ids = inserted.outcomes.iter().filter_map(|it| it.id()).collect();
                }
                Err(error)
            }
        }
    }

    /// The number of rows whose outcomes and neighbours fit into one answer.
    fn rows_of_answer(&self, limits: &Limits) -> usize {
        const OUTCOME_ID_AND_COUNT_BYTES: usize = 16;
        let neighbors = self.neighbors.as_ref().and_then(|spec| {
            let neighbor = spec.include.neighbor_bytes(self.index.coordinates());
            Some(neighbor.saturating_mul(spec.bounds.max_neighbors()?))
        });
        let row = neighbors
            .unwrap_or(0)
            .saturating_add(OUTCOME_ID_AND_COUNT_BYTES);
        limits::rows_of_answer(self.index.client(), limits, row)
    }

    fn row_bytes(&self, states: &States, row: usize) -> usize {
        8 * states.width() + ID_AND_TAG_BYTES + payload_bytes(&self.payloads, row)
    }

    fn message(
        &self,
        states: &States,
        part: &std::ops::Range<usize>,
        operation_id: &str,
    ) -> v1::InsertRequest {
        let on_conflict = match self.replace {
            true => v1::OnConflict::Replace,
            false => v1::OnConflict::Unspecified,
        };
        v1::InsertRequest {
            index_name: self.index.name().to_owned(),
            states: Some(states.to_message(part.clone())),
            ids: column(&self.ids, part),
            tags: column(&self.tags, part),
            payloads: column(&self.payloads, part),
            on_conflict: on_conflict.into(),
            min_separation: self.min_separation,
            neighbor_spec: self.neighbors.as_ref().map(NeighborSpec::to_message),
            operation_id: operation_id.to_owned(),
            uid: self.index.uid().to_owned(),
        }
    }

    /// Appends the answer to a part of `rows` rows.
    fn append(
        &self,
        mut answer: v1::InsertResponse,
        rows: usize,
        inserted: &mut Inserted,
    ) -> Result<(), Error> {
        inserted.revision = self.index.answered(CALL, answer.revision.take())?;
        let wrong = |problem: &str| Error::protocol(CALL, problem);
        if answer.outcomes.len() != rows || answer.ids.len() != rows {
            return Err(wrong("not an outcome and an id for each row"));
        }
        for (outcome, id) in answer.outcomes().zip(&answer.ids) {
            let outcome =
                Outcome::from_message(outcome, *id).ok_or_else(|| wrong("an unknown outcome"))?;
            inserted.outcomes.push(outcome);
        }
        let Some(spec) = &self.neighbors else {
            return Ok(());
        };
        let (revision, size) = (inserted.revision.clone(), (rows, self.index.coordinates()));
        let neighbors =
            Neighbors::from_message(CALL, answer.neighbors, revision, size, spec.include)?;
        match &mut inserted.neighbors {
            Some(before) => before.append(neighbors),
            none => *none = Some(neighbors),
        }
        Ok(())
    }
}

/// The part of an optional column that belongs to these rows.
fn column<T: Clone>(values: &[T], part: &std::ops::Range<usize>) -> Vec<T> {
    values.get(part.clone()).unwrap_or_default().to_vec()
}
