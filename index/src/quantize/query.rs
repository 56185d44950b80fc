//! A query in the steps of a quantizer, and lower bounds of its distance to a block of quantised rows.
//!
//! All computations are in steps, as `f32`. **Rounding:** quantisation has moved each point by at most the distance
//! [`QuantizedQuery::error`] (or to an end from beyond it: see `quantizer`); the bound of a rotation, computed from
//! cosines, allows for that itself. With u = 2⁻²⁴, a query in steps is off by u of itself, and so is its difference
//! from a code: together by less than 0.012 steps for a difference up to 2¹⁶ steps, and by at most 3u of a greater one.
//! Another 0.02 steps count as moved. All other errors are relative, since no sum of squares cancels: u for each
//! coordinate that is added, 2u for each factor, and less than 32u for the rest.

use super::quantizer::{MAX_CODE, Quantizer};
use crate::{
    Factor, Space,
    kernel::{FactorBounds, point_bounds_2},
    lanes::{Isa, Lanes, Rows},
    space::Part,
};

/// The number of points in a block of codes: two blocks of rows, which take about as long as one, and a cache line for
/// each coordinate.
pub(crate) const CODE_ROWS: usize = 32;

/// A bound on the loss of sums of `f32` to underflow. (The root of that is far less than a hundredth of a step.)
const MIN_KEY: f32 = 1e-36;

/// A state in the steps of a quantizer.
#[derive(Debug)]
pub(crate) struct QuantizedQuery<'a> {
    quantizer: &'a Quantizer,
    /// For each coordinate, the steps above its low; in a rotation, the share of a step in a cosine.
    numbers: Vec<f32>,
    /// For each factor, the share of its lows in a cosine.
    products: Vec<f32>,
}

impl<'a> QuantizedQuery<'a> {
    /// The query for a canonical state.
    pub(crate) fn new(quantizer: &'a Quantizer, space: &Space, state: &[f64]) -> Self {
        let (mut numbers, mut products) = (Vec::with_capacity(state.len()), Vec::new());
        for part in space.parts() {
            let mut product = 0.0;
            for (axis, &x) in part.axes().zip(&state[part.axes()]) {
                let (low, step) = (quantizer.lows[axis], quantizer.steps[axis]);
                let [lo, hi] = quantizer.query_range[axis];
                numbers.push(match part.factor {
                    Factor::SO3 => x * step,
                    _ if step == 0.0 => 0.0,
                    _ => ((x - low) / step).clamp(lo, hi),
                } as f32);
                product += x * low;
            }
            products.push(product as f32);
        }
        Self {
            quantizer,
            numbers,
            products,
        }
    }

    /// The greatest distance that a point has moved, apart from its rotations and from beyond an end.
    pub(crate) fn error(&self) -> f64 {
        self.quantizer.error
    }

    /// A limit of keys, in steps.
    #[inline(always)]
    pub(super) fn limit(&self, limit: f64) -> f32 {
        (limit / self.quantizer.unit * self.quantizer.margin) as f32 + MIN_KEY
    }
}

/// A block of codes: for each coordinate those of all its points.
pub(super) struct Codes<'a> {
    pub(super) query: &'a QuantizedQuery<'a>,
    pub(super) codes: &'a [u16],
}

impl Rows<f32, CODE_ROWS> for Codes<'_> {
    type Stored = u16;

    /// Twice the error of a cosine: by codes the length of half a step in each of four coordinates, 3.06e-5, and by
    /// roundings 34u, 2.1e-6. Rotations nearer than 9e-3 to each other are not pruned.
    const CHORD_SLACK: f64 = 8e-5;

    #[inline(always)]
    fn load<I: Isa>(column: &[u16]) -> Lanes<I, f32, CODE_ROWS> {
        let column = column.first_chunk();
        Lanes::of(I::from_codes(
            column.expect("a column has a code for each lane"),
        ))
    }

    #[inline(always)]
    fn query(&self) -> &[f32] {
        &self.query.numbers
    }

    #[inline(always)]
    fn columns(&self) -> &[u16] {
        self.codes
    }

    #[inline(always)]
    fn period(_: f64) -> f32 {
        MAX_CODE as f32
    }

    #[inline(always)]
    fn cosine_of_lows(&self, part_index: usize) -> f32 {
        self.query.products[part_index]
    }
}

impl FactorBounds<f32, CODE_ROWS> for Codes<'_> {
    #[inline(always)]
    fn bounds_2<I: Isa>(&self, part_index: usize, part: &Part) -> Lanes<I, f32, CODE_ROWS> {
        point_bounds_2(self, part_index, part)
    }

    #[inline(always)]
    fn weight(&self, part_index: usize, _: &Part) -> f32 {
        self.query.quantizer.weights[part_index]
    }

    /// The weights of the factors include it.
    #[inline(always)]
    fn group_weight(&self, _: &Space, _: usize) -> f32 {
        1.0
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::{
        Kernels, Points,
        kernel::{
            KeyMap,
            tests::{scene, space},
        },
        lanes::{Isa, Task},
        quantize,
        space::tests::cases,
    };

    /// The points of a block of codes that may have a key up to a limit.
    struct Within<'a>(&'a Space, &'a QuantizedQuery<'a>, &'a [u16], f64);

    impl Task for Within<'_> {
        type Output = u32;

        #[inline(always)]
        fn run<I: Isa>(self) -> u32 {
            quantize::codes::<I>(self.0, self.1, self.2, self.3)
        }
    }

    /// The distance of two states whose rotations differ by an angle of 1e-2.
    fn small_rotations(space: &Space) -> f64 {
        let rotations = space
            .parts()
            .iter()
            .filter(|part| part.factor == Factor::SO3);
        1e-2 * rotations.map(|part| part.unit_length).sum::<f64>()
    }

    proptest! {
        #![proptest_config(cases(4000))]

        #[test]
        fn codes_rule_out_no_point_within_the_distance(
            seed: u64,
            far in prop_oneof![Just(1.0), Just(1e-9), Just(1e9), Just(1e60)],
            away in prop_oneof![Just(1.0), Just(1.0), Just(1e4), Just(1e9)],
            outlier in prop_oneof![Just(1.0), Just(1.0), Just(-1e3), Just(1e9)],
        ) {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let space = space(&mut rng);
            let (mut query, mut rows) = scene(&space, CODE_ROWS, &mut rng);
            for part in space.parts() {
                if let Factor::RealVector(axes) = part.factor {
                    let axes = part.offset..part.offset + axes;
                    for row in rows.iter_mut().chain([&mut query]) {
                        row[axes.clone()].iter_mut().for_each(|x| *x *= far);
                    }
                    query[axes.clone()].iter_mut().for_each(|x| *x *= away);
                    rows[0][axes].iter_mut().for_each(|x| *x *= outlier);
                }
            }
            let mut points = Points::new(space.coordinates());
            // The first row once and each other four times: the first may lie beyond the codes.
            for (id, row) in (0..).zip(rows.iter().chain(&rows[1..]).chain(&rows[1..]).chain(&rows[1..])) {
                points.push(id, 0, 1, row);
            }
            let Some(quantizer) = Quantizer::of(&space, &points) else {
                // All numbers that count are equal.
                prop_assert!(rows.iter().all(|row| space.distance(row, &rows[0]) == 0.0), "{}", space);
                return Ok(());
            };
            let codes: Vec<u16> = (0..space.coordinates())
                .flat_map(|axis| rows.iter().map(move |row| (axis, row[axis])))
                .map(|(axis, x)| quantizer.code(axis, x))
                .collect();
            let (key_map, prepared) = (KeyMap::new(&space), QuantizedQuery::new(&quantizer, &space, &query));
            let within = |distance: f64, kernels: &Kernels| {
                let limit = key_map.expanded(key_map.limit(distance), prepared.error());
                kernels.run(Within(&space, &prepared, &codes, limit))
            };
            for (lane, row) in rows.iter().enumerate() {
                let distance = space.distance(&query, row);
                // A bound is low by the error of the codes and the slack of small rotations; outside the codes by more.
                let is_far = outlier != 1.0 || distance > 1e9 * prepared.error();
                let nearer = 0.98 * distance - small_rotations(&space) - 4.0 * prepared.error();
                let mut portable = None;
                for kernels in Kernels::available() {
                    let found = (within(distance, kernels), within(nearer, kernels));
                    prop_assert!(found.0 >> lane & 1 == 1, "{} {}", space, distance);
                    prop_assert!(is_far || found.1 >> lane & 1 == 0, "{} {}", space, distance);
                    prop_assert_eq!(found, *portable.get_or_insert(found));
                }
            }
            for kernels in Kernels::available() {
                prop_assert_eq!(within(-1.0, kernels), 0);
            }
        }
    }
}
