//! The points that may be answers, held until a search ends: [`Few`] by bounds of their distances, [`Many`] by the
//! distances themselves.

mod few;
mod many;

pub(crate) use few::{Candidate, Few};
pub(crate) use many::Many;

/// The greatest `k` whose candidates are kept in a sorted list.
pub(crate) const MAX_FEW: usize = 40;
