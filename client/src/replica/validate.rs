//! Validates searches as the server does, with the same messages.

use wayfold_index::{Space, StateProblem};

use crate::{
    Code, Error, FieldViolation, Radius, Refusal, ReplicaSearch, States,
    search::{K, ScaledRadius},
};

/// The violations of a request, and the reason of the first.
#[derive(Default)]
pub(super) struct Violations {
    reason: &'static str,
    fields: Vec<FieldViolation>,
}

impl Violations {
    fn add(&mut self, field: &str, reason: &'static str, problem: impl Into<String>) {
        if self.fields.is_empty() {
            self.reason = reason;
        }
        self.fields.push(FieldViolation {
            field: field.to_owned(),
            problem: problem.into(),
        });
    }

    /// A distance: at least 0.
    fn distance(&mut self, field: &str, number: f64) {
        if number.is_nan() {
            self.add(field, "NAN", "NaN");
        } else if number < 0.0 {
            self.add(field, "NEGATIVE", format!("{number}; it is at least 0"));
        }
    }

    /// A number that is finite and at least 0.
    fn finite(&mut self, field: &str, number: f64) {
        self.distance(field, number);
        if number == f64::INFINITY {
            self.add(field, "INFINITE", "infinite; it is a finite number");
        }
    }

    fn finish(self) -> Result<(), Error> {
        if self.fields.is_empty() {
            return Ok(());
        }
        let texts = self.fields.iter();
        let texts = texts.map(|violation| format!("{}: {}", violation.field, violation.problem));
        Err(Error::Refused(Box::new(Refusal {
            code: Code::InvalidArgument,
            message: texts.collect::<Vec<_>>().join("; "),
            reason: self.reason.to_owned(),
            metadata: Default::default(),
            fields: self.fields,
            ids: Vec::new(),
            retry_after: None,
        })))
    }
}

/// The violations of a search, in the server's order.
pub(super) fn check(search: &ReplicaSearch) -> Violations {
    let mut violations = Violations::default();
    match search.bounds.k {
        Some(K::Fixed(0)) => violations.add("k", "ZERO", "k is at least 1"),
        Some(K::Scaled(factor)) => violations.finite("k_factor", factor),
        Some(K::Fixed(_)) | None => {}
    }
    match search.bounds.radius {
        Some(Radius::Fixed(radius)) => violations.distance("radius", radius),
        Some(Radius::Scaled(ScaledRadius { factor, max })) => {
            violations.finite("scaled_radius.factor", factor);
            if let Some(max) = max {
                violations.distance("scaled_radius.max", max);
            }
        }
        None => {}
    }
    let (mask, value) = (search.filter.tag_mask, search.filter.tag_value);
    if value & !mask != 0 {
        let problem =
            format!("{value:#x} has bits outside tag_mask = {mask:#x}: no tag could match");
        violations.add("filter.tag_value", "OUTSIDE_MASK", problem);
    }
    violations.finite("epsilon", search.epsilon);
    violations
}

/// The one state of `states` in canonical form, unless it or the search has violations.
pub(super) fn canonical(
    space: &Space,
    states: States,
    mut violations: Violations,
) -> Result<Vec<f64>, Error> {
    let mut row = states.into_coordinates();
    if let Err(error) = space.canonicalize(&mut row) {
        let reason = match error.reason {
            StateProblem::NaN => "NAN",
            StateProblem::Infinite => "INFINITE",
            StateProblem::TooLarge => "TOO_LARGE",
            StateProblem::Norm(_) => "NORM",
            StateProblem::Width { .. } => "WIDTH",
            StateProblem::NotCanonical => "NOT_CANONICAL",
        };
        let field = format!("states[0].coords[{}]", error.coordinate);
        violations.add(&field, reason, error.reason.to_string());
    }
    violations.finish()?;
    Ok(row)
}
