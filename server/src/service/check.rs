//! Checks requests: they become canonical rows and searches, or a list of violations.

use std::collections::{HashMap, hash_map};

use bytes::Bytes;
use wayfold_index::{Filter, Space, StateError, StateProblem};
use wayfold_proto::{END_OF_IDS, v1};

use super::{Error, Limits, Violation, call::TimeSlicer, read_view::revision_number};
use crate::registry::Hosted;

/// The first few violations of a request.
#[derive(Default)]
pub(super) struct Violations(Vec<Violation>);

impl Violations {
    const MAX_COUNT: usize = 10;

    pub(super) fn add(
        &mut self,
        field: impl Into<String>,
        reason: &'static str,
        description: impl Into<String>,
    ) {
        if !self.are_enough() {
            self.0.push(Violation {
                field: field.into(),
                reason,
                description: description.into(),
            });
        }
    }

    /// True if no further violation would be kept.
    pub(super) fn are_enough(&self) -> bool {
        self.0.len() >= Self::MAX_COUNT
    }

    pub(super) fn finish(self) -> Result<(), Error> {
        if self.0.is_empty() {
            Ok(())
        } else {
            Err(Error::InvalidArgument { violations: self.0 })
        }
    }
}

/// States of a space: canonical rows.
pub(super) struct Rows {
    width: usize,
    coordinates: Vec<f64>,
}

impl Rows {
    pub(super) fn iter(&self) -> impl ExactSizeIterator<Item = &[f64]> {
        self.coordinates.chunks_exact(self.width)
    }

    /// The row with this number, which is below [`Rows::len`].
    pub(super) fn row(&self, at: usize) -> &[f64] {
        &self.coordinates[at * self.width..(at + 1) * self.width]
    }

    pub(super) fn len(&self) -> usize {
        self.coordinates.len() / self.width
    }
}

/// Checks states and canonicalises them.
pub(super) async fn states(
    space: &Space,
    states: Option<v1::States>,
    limits: &Limits,
    pace: &mut TimeSlicer,
    violations: &mut Violations,
) -> Result<Rows, Error> {
    let width = space.coordinates();
    let mut checked = Rows {
        width,
        coordinates: Vec::new(),
    };
    let Some(states) = states else {
        violations.add("states", "REQUIRED", "the states are missing");
        return Ok(checked);
    };
    let rows = states.row_count as usize;
    let advice = "split the states over several calls";
    at_most("max_rows_per_call", limits.max_rows_per_call, rows, advice)?;
    let found = states.coordinates.len();
    if found != rows * width {
        violations.add(
            "states.coordinates",
            "WIDTH",
            format!(
                "{found} numbers; {rows} rows of {width} coordinates, as {space} has, are {}",
                rows * width
            ),
        );
        return Ok(checked);
    }
    checked.coordinates = states.coordinates;
    for (at, row) in checked.coordinates.chunks_exact_mut(width).enumerate() {
        if let Err(error) = space.canonicalize(row) {
            violations.add(
                format!("states[{at}].coords[{}]", error.coordinate),
                state_reason(&error),
                error.reason.to_string(),
            );
            if violations.are_enough() {
                break;
            }
        }
        if at % 64 == 63 {
            pace.step().await?;
        }
    }
    Ok(checked)
}

fn state_reason(error: &StateError) -> &'static str {
    match error.reason {
        StateProblem::NaN => "NAN",
        StateProblem::Infinite => "INFINITE",
        StateProblem::TooLarge => "TOO_LARGE",
        StateProblem::Norm(_) => "NORM",
        StateProblem::Width { .. } => "WIDTH",
        StateProblem::NotCanonical => "NOT_CANONICAL",
    }
}

/// Ids are below 2^63, each once.
pub(super) async fn ids(
    ids: &[u64],
    pace: &mut TimeSlicer,
    violations: &mut Violations,
) -> Result<(), Error> {
    let mut first = HashMap::with_capacity(ids.len());
    for (at, &id) in ids.iter().enumerate() {
        if id >= END_OF_IDS {
            let text = format!("{id}: ids are below 2^63");
            violations.add(format!("ids[{at}]"), "ID_TOO_LARGE", text);
        }
        match first.entry(id) {
            hash_map::Entry::Vacant(entry) => {
                entry.insert(at);
            }
            hash_map::Entry::Occupied(entry) => {
                let text = format!(
                    "{id} is ids[{}] already: a call names an id once",
                    entry.get()
                );
                violations.add(format!("ids[{at}]"), "DUPLICATE_ID", text);
            }
        }
        if violations.are_enough() {
            break;
        }
        if at % 1024 == 1023 {
            pace.step().await?;
        }
    }
    Ok(())
}

/// Fails if `requested` exceeds the limit of this name.
pub(super) fn at_most(
    limit: &'static str,
    max: usize,
    requested: usize,
    advice: &'static str,
) -> Result<(), Error> {
    if requested <= max {
        return Ok(());
    }
    Err(Error::LimitExceeded {
        limit,
        value: max as u64,
        requested: requested as u64,
        advice,
    })
}

/// Most ids of a call that names points by id.
pub(super) fn id_count(ids: &[u64], limits: &Limits) -> Result<(), Error> {
    let (count, max) = (ids.len(), limits.max_ids_per_call);
    let advice = "split the ids over several calls";
    at_most("max_ids_per_call", max, count, advice)
}

/// A column has an entry for each row, or none at all.
pub(super) fn column<T>(field: &str, column: &[T], rows: usize, violations: &mut Violations) {
    if !column.is_empty() && column.len() != rows {
        let text = format!(
            "{} entries for {rows} rows: one a row, or none",
            column.len()
        );
        violations.add(field, "COUNT", text);
    }
}

pub(super) fn payloads(payloads: &[Bytes], limits: &Limits, violations: &mut Violations) {
    for (at, payload) in payloads.iter().enumerate() {
        if payload.len() > limits.max_payload_bytes {
            violations.add(
                format!("payloads[{at}]"),
                "PAYLOAD_TOO_LARGE",
                format!(
                    "{} bytes; a payload has at most {}",
                    payload.len(),
                    limits.max_payload_bytes
                ),
            );
        }
    }
}

/// An operation id has at most 64 bytes.
pub(super) fn operation_id(id: &str, violations: &mut Violations) {
    if id.len() > 64 {
        let text = format!("{} bytes; an operation id has at most 64", id.len());
        violations.add("operation_id", "TOO_LONG", text);
    }
}

/// A distance: at least 0, infinity allowed.
pub(super) fn radius(field: &str, radius: f64, violations: &mut Violations) {
    if radius.is_nan() {
        violations.add(field, "NAN", "NaN");
    } else if radius < 0.0 {
        violations.add(field, "NEGATIVE", format!("{radius}; it is at least 0"));
    }
}

/// A number that is finite and at least 0.
pub(super) fn finite(field: &str, number: f64, violations: &mut Violations) {
    radius(field, number, violations);
    if number == f64::INFINITY {
        violations.add(field, "INFINITE", "infinite; it is a finite number");
    }
}

/// A number of neighbours: at least 1, at most `limits.max_k`.
pub(super) fn k(
    field: &str,
    k: u32,
    limits: &Limits,
    violations: &mut Violations,
) -> Result<usize, Error> {
    let k = k as usize;
    if k == 0 {
        violations.add(field, "ZERO", "k is at least 1");
    }
    k_limit(k, limits.max_k)?;
    Ok(k)
}

/// Fails if a number of neighbours exceeds `limit`.
pub(super) fn k_limit(k: usize, limit: usize) -> Result<(), Error> {
    let advice = "ask for fewer neighbours, or for all within a radius";
    at_most("max_k", limit, k, advice)
}

/// A filter of the points of `hosted`; `field` is its path.
pub(super) fn filter(
    field: &str,
    filter: Option<v1::Filter>,
    hosted: &Hosted,
    violations: &mut Violations,
) -> Result<Filter, Error> {
    let filter = filter.unwrap_or_default();
    if filter.tag_value & !filter.tag_mask != 0 {
        violations.add(
            format!("{field}.tag_value"),
            "OUTSIDE_MASK",
            format!(
                "{:#x} has bits outside tag_mask = {:#x}: no tag could match",
                filter.tag_value, filter.tag_mask
            ),
        );
    }
    Ok(Filter {
        tag_mask: filter.tag_mask,
        tag_value: filter.tag_value,
        since_revision: revision_number(
            hosted,
            &format!("{field}.since_revision"),
            filter.since_revision.as_ref(),
            violations,
        )?,
    })
}
