//! Uniformly drawn states.

use std::f64::consts::TAU;

use rand::{Rng, RngExt};
use wayfold::{Factor, Space};

/// A canonical state, drawn uniformly: the real coordinates within their bounds, and all angles and rotations.
///
/// The result depends only on the generator, on every machine: transcendental functions come from `libm`.
///
/// # Panics
/// If there are fewer bounds than real coordinates.
pub fn uniform(space: &Space, bounds: &[(f64, f64)], rng: &mut impl Rng) -> Vec<f64> {
    let mut row = Vec::with_capacity(space.coordinates());
    let mut bounds = bounds.iter();
    for term in space.groups().iter().flat_map(|group| &group.terms) {
        match term.factor {
            Factor::RealVector(n) => {
                for _ in 0..n {
                    let &(low, high) = bounds.next().expect("a bound for each real coordinate");
                    row.push(low + (high - low) * rng.random::<f64>());
                }
            }
            Factor::SO2 { period } => row.push(period * (rng.random::<f64>() - 0.5)),
            Factor::SO3 => row.extend(rotation(rng)),
        }
    }
    let canonical = space.canonicalize(&mut row);
    assert!(canonical.is_ok(), "{row:?} is within finite bounds");
    row
}

/// A rotation drawn uniformly: K. Shoemake, "Uniform random rotations", Graphics Gems III, 1992.
fn rotation(rng: &mut impl Rng) -> [f64; 4] {
    let share = rng.random::<f64>();
    let (first, second) = (TAU * rng.random::<f64>(), TAU * rng.random::<f64>());
    let (rest, share) = ((1.0 - share).sqrt(), share.sqrt());
    [
        rest * libm::sin(first),
        rest * libm::cos(first),
        share * libm::sin(second),
        share * libm::cos(second),
    ]
}
