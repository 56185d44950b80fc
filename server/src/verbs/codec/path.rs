//! Paths to fields of a request.

use std::fmt;

/// A path in the service's notation: `neighbor_spec.filter.tag_mask`, `states[37].coords[3]`.
#[derive(Clone, Copy)]
pub(super) struct Path<'a> {
    before: Option<&'a Path<'a>>,
    step: Step<'a>,
}

#[derive(Clone, Copy)]
enum Step<'a> {
    Field(&'a str),
    At(usize),
}

impl<'a> Path<'a> {
    /// A field of the request.
    pub(super) fn of(name: &'a str) -> Self {
        Self {
            before: None,
            step: Step::Field(name),
        }
    }

    /// A field of the value at this path.
    pub(super) fn field(&'a self, name: &'a str) -> Self {
        Self {
            before: Some(self),
            step: Step::Field(name),
        }
    }

    /// An element of the value at this path.
    pub(super) fn at(&'a self, index: usize) -> Self {
        Self {
            before: Some(self),
            step: Step::At(index),
        }
    }
}

impl fmt::Display for Path<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(before) = self.before {
            before.fmt(f)?;
        }
        match self.step {
            Step::Field(name) if self.before.is_none() => write!(f, "{name}"),
            Step::Field(name) => write!(f, ".{name}"),
            Step::At(index) => write!(f, "[{index}]"),
        }
    }
}
