//! Typed states: types that can be sent as one row of numbers, and read back from one.

#[cfg(feature = "nalgebra")]
mod geometry;

use wayfold_index::Space;

use crate::{
    Error,
    layout::{self, Coordinate},
};

/// One state, as a row of numbers in the order of its space.
///
/// Implemented for arrays, vectors and slices of `f64`, and, with the feature `nalgebra`, for its types that are
/// states: `Isometry2` (x, y, θ), `Isometry3` (x, y, z, qx, qy, qz, qw), `UnitComplex` (θ), `UnitQuaternion` (qx, qy,
/// qz, qw), `Point` and vectors.
///
/// ```
/// use wayfold::State;
///
/// /// A car and its trailer, in R2*SO2*SO2.
/// struct Rig { position: [f64; 2], heading: f64, hitch: f64 }
///
/// impl State for Rig {
///     fn write(&self, row: &mut Vec<f64>) {
///         row.extend(self.position);
///         row.extend([self.heading, self.hitch]);
///     }
/// }
/// ```
pub trait State {
    /// Appends the state's numbers.
    fn write(&self, row: &mut Vec<f64>);

    /// The kinds of the numbers, if the type fixes them. The client compares them with the space before it sends
    /// anything. `None` stands for plain numbers; the client checks only their count.
    fn layout() -> Option<&'static [Coordinate]> {
        None
    }
}

/// A state that can be read back from a row of its space.
pub trait FromState: Sized {
    /// The state with these numbers, or `None` if there are not as many as it has.
    fn from_state(row: &[f64]) -> Option<Self>;
}

/// Refuses a type whose coordinates are not those of the space, which are `expected`.
pub(crate) fn check_layout<S: State>(space: &Space, expected: &[Coordinate]) -> Result<(), Error> {
    match S::layout() {
        Some(given) if given != expected => Err(Error::Layout {
            state: std::any::type_name::<S>(),
            given: layout::describe(given),
            space: space.to_string(),
            expected: layout::describe(expected),
        }),
        _ => Ok(()),
    }
}

impl<S: State + ?Sized> State for &S {
    fn write(&self, row: &mut Vec<f64>) {
        (**self).write(row);
    }

    fn layout() -> Option<&'static [Coordinate]> {
        S::layout()
    }
}

impl State for [f64] {
    fn write(&self, row: &mut Vec<f64>) {
        row.extend_from_slice(self);
    }
}

impl State for Vec<f64> {
    fn write(&self, row: &mut Vec<f64>) {
        row.extend_from_slice(self);
    }
}

impl FromState for Vec<f64> {
    fn from_state(row: &[f64]) -> Option<Self> {
        Some(row.to_vec())
    }
}

impl<const N: usize> State for [f64; N] {
    fn write(&self, row: &mut Vec<f64>) {
        row.extend_from_slice(self);
    }
}

impl<const N: usize> FromState for [f64; N] {
    fn from_state(row: &[f64]) -> Option<Self> {
        row.try_into().ok()
    }
}
