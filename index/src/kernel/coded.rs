//! Lower bounds of the distance from a state to a block of points whose numbers are *codes* of sixteen bits: of each
//! coordinate, how many steps it lies above the least. (Such a table is the VA-file of Weber, Schek and Blott, "A Quantitative
//! Analysis and Performance Study for Similarity-Search Methods in High-Dimensional Spaces", VLDB 1998.)
//!
//! All is computed in steps, as `f32`. **Rounding:** codes are of points that have moved, by no more than
//! [`Asked::error`], a distance (and from beyond an end to it: see `coding`); only rotations, whose bound is of cosines, allow
//! for that themselves. With u = 2⁻²⁴, a state in steps is off by u of itself, and so is its difference from a code: together by
//! less than 0.012 steps where the difference is up to 2¹⁶ steps, and by no more than 3u of it where it is greater; 0.02 steps
//! count as moved, too. All else is relative, since no sum of squares cancels: u for each coordinate that is added, 2u for each
//! factor, and less than 32u for the rest.

use super::{
    bound::{Terms, angle_2},
    coding::{Coding, MOST},
    compiled::Set,
    lanes::Lanes,
};
use crate::{Factor, Space, space::Part};

/// How many points a block of codes has: those of two other blocks, which take about as long as one, and of each coordinate
/// a line of a cache.
pub(crate) const CODES: usize = 32;

/// How far a squared chord may lie below 2 − 2·|x·y|: twice of what a cosine loses. By codes that is the length of half a
/// step in each of four coordinates, 3.06e-5, and by roundings 34u, 2.1e-6. What is lost is the pruning among rotations
/// nearer than 9e-3 to each other.
const COSINE_SLACK: f64 = 8e-5;

/// More than what sums of `f32` lose where that is not relative. (What a root then loses is far less than a hundredth of a
/// step.)
const LEAST_KEY: f32 = 1e-36;

/// A state in the steps of a coding.
#[derive(Debug)]
pub(crate) struct Asked<'a> {
    coding: &'a Coding,
    /// Of each coordinate, how many steps it lies above the low; of a rotation's, what a step of it adds to a cosine.
    numbers: Vec<f32>,
    /// What the lows of each factor, multiplied with the state, add to its cosines.
    products: Vec<f32>,
}

impl<'a> Asked<'a> {
    /// About a canonical state.
    pub(crate) fn new(coding: &'a Coding, space: &Space, state: &[f64]) -> Self {
        let (mut numbers, mut products) = (Vec::with_capacity(state.len()), Vec::new());
        for part in space.parts() {
            let axes = part.offset..part.offset + part.factor.coordinates();
            let mut product = 0.0;
            for (axis, &x) in axes.clone().zip(&state[axes]) {
                let (low, step, [least, most]) =
                    (coding.lows[axis], coding.steps[axis], coding.within[axis]);
                numbers.push(match part.factor {
                    Factor::SO3 => x * step,
                    _ if step == 0.0 => 0.0,
                    _ => ((x - low) / step).clamp(least, most),
                } as f32);
                product += x * low;
            }
            products.push(product as f32);
        }
        Self {
            coding,
            numbers,
            products,
        }
    }

    /// No point has moved farther than this, but by its rotations, and to an end from beyond it.
    pub(crate) fn error(&self) -> f64 {
        self.coding.error
    }

    /// A limit of keys in steps.
    #[inline(always)]
    pub(super) fn limit(&self, limit: f64) -> f32 {
        (limit / self.coding.unit * self.coding.margin) as f32 + LEAST_KEY
    }
}

/// Points: coordinate by coordinate the codes of all of them.
pub(super) struct Coded<'a> {
    pub(super) asked: &'a Asked<'a>,
    pub(super) codes: &'a [u16],
}

impl Terms<f32, CODES> for Coded<'_> {
    #[inline(always)]
    fn term<S: Set>(&self, place: usize, part: &Part) -> Lanes<S, f32, CODES> {
        let zero = Lanes::splat(0.0);
        let axes = part.offset..part.offset + part.factor.coordinates();
        let numbers = &self.asked.numbers[axes.clone()];
        let codes = &self.codes[axes.start * CODES..axes.end * CODES];
        match part.factor {
            Factor::RealVector(_) => {
                let mut sum_2 = zero;
                for (&x, column) in numbers.iter().zip(codes.chunks_exact(CODES)) {
                    let d = Lanes::splat(x) - widened(column);
                    sum_2 = sum_2 + d * d;
                }
                sum_2
            }
            Factor::SO2 { .. } => {
                let direct = (Lanes::splat(numbers[0]) - widened(codes)).abs();
                let d = direct.min(Lanes::splat(MOST as f32) - direct).max(zero);
                d * d
            }
            Factor::SO3 => {
                let mut cosine = Lanes::splat(self.asked.products[place]);
                for (&x, column) in numbers.iter().zip(codes.chunks_exact(CODES)) {
                    cosine = cosine + Lanes::splat(x) * widened(column);
                }
                let cosine = cosine.abs();
                angle_2((Lanes::splat((2.0 - COSINE_SLACK) as f32) - (cosine + cosine)).max(zero))
            }
        }
    }

    #[inline(always)]
    fn weight(&self, place: usize, _: &Part) -> f32 {
        self.asked.coding.weights[place]
    }

    /// Their weights are in those of their factors.
    #[inline(always)]
    fn group_weight(&self, _: &Space, _: usize) -> f32 {
        1.0
    }
}

/// The codes of a column as numbers.
#[inline(always)]
fn widened<S: Set>(column: &[u16]) -> Lanes<S, f32, CODES> {
    let column = column
        .first_chunk()
        .expect("a column has a code for each lane");
    Lanes::of(S::widen(column))
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
            self, Scale, Task,
            tests::{scene, space},
        },
        space::tests::cases,
    };

    /// The points of a block of codes that may have a key up to a limit.
    struct Within<'a>(&'a Space, &'a Asked<'a>, &'a [u16], f64);

    impl Task for Within<'_> {
        type Output = u32;

        #[inline(always)]
        fn run<S: Set>(self) -> u32 {
            kernel::coded::<S>(self.0, self.1, self.2, self.3)
        }
    }

    /// How far apart states of a space are whose rotations differ by an angle of 1e-2.
    fn small_rotations(space: &Space) -> f64 {
        let rotations = space
            .parts()
            .iter()
            .filter(|part| part.factor == Factor::SO3);
        let scaled = rotations.map(|part| space.groups()[part.group].weight * part.weight.sqrt());
        1e-2 * scaled.sum::<f64>()
    }

    proptest! {
        #![proptest_config(cases(4000))]

        #[test]
        fn no_point_within_reach_is_lost_by_codes(
            seed: u64,
            far in prop_oneof![Just(1.0), Just(1e-9), Just(1e9), Just(1e60)],
            away in prop_oneof![Just(1.0), Just(1.0), Just(1e4), Just(1e9)],
            outlier in prop_oneof![Just(1.0), Just(1.0), Just(-1e3), Just(1e9)],
        ) {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let space = space(&mut rng);
            let (mut query, mut rows) = scene(&space, CODES, &mut rng);
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
            // One of the first and four of each other: the first may lie beyond the codes.
            for (id, row) in (0..).zip(rows.iter().chain(&rows[1..]).chain(&rows[1..]).chain(&rows[1..])) {
                points.push(id, 0, 1, row);
            }
            let Some(coding) = Coding::of(&space, &points) else {
                // All numbers that count are equal.
                prop_assert!(rows.iter().all(|row| space.distance(row, &rows[0]) == 0.0), "{}", space);
                return Ok(());
            };
            let codes: Vec<u16> = (0..space.coordinates())
                .flat_map(|axis| rows.iter().map(move |row| (axis, row[axis])))
                .map(|(axis, x)| coding.code(axis, x))
                .collect();
            let (scale, asked) = (Scale::new(&space), Asked::new(&coding, &space, &query));
            let within = |distance: f64, kernels: &Kernels| {
                let limit = scale.loosened(scale.limit(distance), asked.error());
                kernels.run(Within(&space, &asked, &codes, limit))
            };
            for (lane, row) in rows.iter().enumerate() {
                let distance = space.distance(&query, row);
                // What is lost is what codes may move a point, and what small rotations are worth; outside, more.
                let is_far = outlier != 1.0 || distance > 1e9 * asked.error();
                let nearer = 0.98 * distance - small_rotations(&space) - 4.0 * asked.error();
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
