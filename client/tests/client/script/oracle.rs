//! The truth of the script: brute force over a table, and the errors in words of its own.

use wayfold::Space;
use wayfold_index::{Linear, PointRef, Search};

use super::operation::{Answer, Operation};

/// The points of the newest index of the script.
pub(crate) struct Oracle {
    points: Linear,
    next_id: u64,
}

/// A refused operation.
type Refusal = Answer;

fn invalid(field: &str, problem: impl std::fmt::Display) -> Refusal {
    Answer::Refused {
        code: "INVALID_ARGUMENT",
        message: format!("{field}: {problem}"),
    }
}

impl Oracle {
    pub(crate) fn new(space: &Space) -> Oracle {
        Oracle {
            points: Linear::new(space.clone()),
            next_id: 0,
        }
    }

    /// Answers an operation; none for a space, which begins a new table.
    pub(crate) fn answer(&mut self, operation: Operation) -> Option<Answer> {
        if let Operation::Space(text) = &operation {
            *self = Oracle::new(&text.parse().unwrap());
            return None;
        }
        Some(self.try_answer(operation).unwrap_or_else(|refusal| refusal))
    }

    fn try_answer(&mut self, operation: Operation) -> Result<Answer, Refusal> {
        let all = Search::nearest_k(usize::MAX);
        Ok(match operation {
            Operation::Space(_) => unreachable!("answered above"),
            Operation::Insert(state) => Answer::Number(self.insert(None, 0, state)?),
            Operation::InsertWith { id, tag, state } => {
                Answer::Number(self.insert(id, tag, state)?)
            }
            Operation::InsertMany(states) => {
                let rows = states.into_iter().enumerate();
                let rows: Vec<_> = rows
                    .map(|(at, state)| self.canonical(at, state))
                    .collect::<Result<_, _>>()?;
                Answer::Ids(rows.iter().map(|row| self.store(None, 0, row)).collect())
            }
            Operation::Replace { id, state } => {
                let row = self.canonical(0, state)?;
                let tag = self.points.get(id).map(|point| point.tag);
                Answer::Done(tag.map(|tag| self.store(Some(id), tag, &row)).is_some())
            }
            Operation::Remove { id } => Answer::Done(self.points.remove(id)),
            Operation::SetTag { id, tag } => {
                let row = self.points.get(id).map(|point| point.row.to_vec());
                Answer::Done(row.map(|row| self.store(Some(id), tag, &row)).is_some())
            }
            Operation::Get { id } => {
                let point = self.points.get(id);
                Answer::Point(point.map(|point| (point.tag, point.row.to_vec())))
            }
            Operation::Len => Answer::Number(self.points.len() as u64),
            Operation::Nearest(state) => self.search(state, Search { k: 1, ..all })?,
            Operation::NearestK { k, state } => {
                check_k(k)?;
                self.search(
                    state,
                    Search {
                        k: k as usize,
                        ..all
                    },
                )?
            }
            Operation::NearestR { radius, state } => {
                check_radius(radius)?;
                self.search(state, Search { radius, ..all })?
            }
            Operation::Search {
                k,
                radius,
                tag_mask,
                tag_value,
                epsilon,
                state,
            } => {
                k.map_or(Ok(()), check_k)?;
                check_radius(radius)?;
                check_epsilon(epsilon)?;
                if tag_value & !tag_mask != 0 {
                    let problem = format!("{tag_value:#x} has bits outside the mask {tag_mask:#x}");
                    return Err(invalid("tag", problem + ": no tag could match"));
                }
                let mut search = Search { radius, ..all };
                search.k = k.map_or(usize::MAX, |k| k as usize);
                (search.filter.tag_mask, search.filter.tag_value) = (tag_mask, tag_value);
                self.search(state, search)?
            }
        })
    }

    /// The row of a state, the one of number `at` in its call.
    fn canonical(&self, at: usize, state: Vec<f64>) -> Result<Vec<f64>, Refusal> {
        let expected = self.points.space().coordinates();
        if state.len() != expected {
            let problem = format!(
                "{} numbers, where a state of this space has {expected}",
                state.len()
            );
            return Err(invalid(&format!("states[{at}]"), problem));
        }
        let mut row = state;
        let canonical = self.points.space().canonicalize(&mut row);
        canonical.map_err(|error| {
            let field = format!("states[{at}].coords[{}]", error.coordinate);
            invalid(&field, error.reason)
        })?;
        Ok(row)
    }

    fn insert(&mut self, id: Option<u64>, tag: u64, state: Vec<f64>) -> Result<u64, Refusal> {
        let row = self.canonical(0, state)?;
        match id {
            Some(id) if id >= 1 << 63 => Err(invalid("id", format!("{id}; ids are below 2^63"))),
            Some(id) if self.points.get(id).is_some() => {
                let problem =
                    "a point has it, or the index assigns it; replace moves a stored point";
                Err(Answer::Refused {
                    code: "ALREADY_EXISTS",
                    message: format!("id {id}: {problem}"),
                })
            }
            id => Ok(self.store(id, tag, &row)),
        }
    }

    fn store(&mut self, id: Option<u64>, tag: u64, row: &[f64]) -> u64 {
        let id = id.unwrap_or(self.next_id);
        self.next_id = self.next_id.max(id + 1);
        let revision = 0;
        let point = PointRef {
            id,
            tag,
            revision,
            row,
        };
        self.points.insert(point).unwrap();
        id
    }

    fn search(&self, state: Vec<f64>, search: Search<'_>) -> Result<Answer, Refusal> {
        let row = self.canonical(0, state)?;
        let answer = self.points.search(&row, &search).unwrap();
        Ok(Answer::Neighbors(answer.neighbors))
    }
}

fn check_k(k: u32) -> Result<(), Refusal> {
    match k {
        0 => Err(invalid("k", "0; it is at least 1")),
        _ => Ok(()),
    }
}

fn check_radius(radius: f64) -> Result<(), Refusal> {
    match radius {
        _ if radius.is_nan() => Err(invalid("radius", "NaN")),
        _ if radius < 0.0 => Err(invalid("radius", format!("{radius}; it is at least 0"))),
        _ => Ok(()),
    }
}

fn check_epsilon(epsilon: f64) -> Result<(), Refusal> {
    match epsilon {
        f64::INFINITY => Err(invalid("epsilon", "infinite; it is a finite number")),
        _ if epsilon.is_nan() => Err(invalid("epsilon", "NaN")),
        _ if epsilon < 0.0 => Err(invalid("epsilon", format!("{epsilon}; it is at least 0"))),
        _ => Ok(()),
    }
}
