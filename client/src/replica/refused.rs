//! Refusing what the server refuses, in its words.

use wayfold_index::{Scaling, Search, Space, StateProblem};

use crate::{Code, Error, FieldViolation, Refusal, States};

/// What is wrong with a request: the reason of the first violation, and all of them.
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
        let told = self.fields.iter();
        let told = told.map(|violation| format!("{}: {}", violation.field, violation.problem));
        Err(Error::Refused(Box::new(Refusal {
            code: Code::InvalidArgument,
            message: told.collect::<Vec<_>>().join("; "),
            reason: self.reason.to_owned(),
            metadata: Default::default(),
            fields: self.fields,
            ids: Vec::new(),
        })))
    }
}

/// What is wrong with a search.
pub(super) fn check(search: &Search<'_>) -> Violations {
    let mut violations = Violations::default();
    if search.k == 0 {
        violations.add("k", "ZERO", "k is at least 1");
    }
    violations.distance("radius", search.radius);
    violations.finite("epsilon", search.epsilon);
    let (mask, value) = (search.filter.tag_mask, search.filter.tag_value);
    if value & !mask != 0 {
        let problem =
            format!("{value:#x} has bits outside tag_mask = {mask:#x}: no tag could match");
        violations.add("filter.tag_value", "OUTSIDE_MASK", problem);
    }
    violations
}

/// What is wrong with factors.
pub(super) fn check_scaling(scaling: Scaling) -> Result<(), Error> {
    let mut violations = Violations::default();
    for (field, factor) in [
        ("scaling.k_factor", scaling.k_factor),
        ("scaling.radius_factor", scaling.radius_factor),
    ] {
        if let Some(factor) = factor {
            violations.finite(field, factor);
        }
    }
    if let Some(most) = scaling.radius_max {
        violations.distance("scaling.radius_max", most);
        if scaling.radius_factor.is_none() {
            let problem = "radius_max needs it; a radius that is fixed is radius";
            violations.add("scaling.radius_factor", "REQUIRED", problem);
        }
    }
    violations.finish()
}

/// The one state of `states` in canonical form, if nothing is wrong with it nor was before.
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
