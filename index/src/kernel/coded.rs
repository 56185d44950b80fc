//! Lower bounds of the distance from a state to a block of points whose numbers are *codes* of sixteen bits: of each
//! coordinate, how many steps it lies above the least. (Such a table is the VA-file of Weber, Schek and Blott, "A Quantitative
//! Analysis and Performance Study for Similarity-Search Methods in High-Dimensional Spaces", VLDB 1998.)
//!
//! All is computed in steps, as `f32`. **Rounding:** codes are of points that have moved, by no more than
//! [`Asked::error`], a distance; only rotations, whose bound is of cosines, allow for that themselves. With u = 2⁻²⁴, a
//! state in steps is off by u of itself, and so is its difference from a code: together by less than a hundredth of a step up
//! to 2¹⁷ steps, which counts as moved, too, and by less than 5u of the difference where it is greater. All else is relative,
//! since no sum of squares cancels: u for each coordinate that is added, 2u for each factor, and less than 32u for the rest.
//!
//! Few points may lie far from all others: codes end where those do, and points beyond stand at the end. That brings none
//! farther from a state that is brought to the same end.

use super::{
    bound::{Terms, angle_2},
    compiled::Set,
    lanes::Lanes,
};
use crate::{Factor, Points, Space, space::Part};

/// How many points a block of codes has: those of two other blocks, which take about as long as one, and of each coordinate
/// a line of a cache.
pub(crate) const CODES: usize = 32;

/// The greatest code.
const MOST: f64 = u16::MAX as f64;

/// How far a coordinate may have moved, in steps: by half of one, and a hundredth for each of two differences.
const MOVED: f64 = 0.52;

/// How far a squared chord may lie below 2 − 2·|x·y|: twice of what a cosine loses. By codes that is the length of half a
/// step in each of four coordinates, 3.06e-5, and by roundings 34u, 2.1e-6. What is lost is the pruning among rotations
/// nearer than 9e-3 to each other.
const COSINE_SLACK: f64 = 8e-5;

/// A state that lies farther outside counts as if it lay here, which is nearer: so many steps have a square in range.
const FARTHEST: f64 = (1_u64 << 50) as f64;

/// No step need be worth less than this part of another: that would tell nothing more, and of points that lie at one place
/// in a factor, any other place would be out of reach.
const FINEST: f64 = 1e-3;

/// A factor whose squared step counts less than this part of the one that counts most is left out.
const LEAST_SHARE: f64 = 1e-30;

/// The squared steps, and the keys, that 1 may stand for: with others, products may be out of range.
const UNITS: std::ops::Range<f64> = 1e-200..1e200;

/// More than what sums of `f32` lose where that is not relative. (What a root then loses is far less than a hundredth of a
/// step.)
const LEAST_KEY: f32 = 1e-36;

/// So many points tell where nearly all of them lie: between what is left of a fiftieth of them on either side, ...
const SAMPLE: usize = 512;
const TAIL: usize = 50;

/// ... and so many times the distance of those beyond.
const BEYOND: f64 = 1.0;

/// What the codes of some points mean.
#[derive(Clone, Debug)]
pub(crate) struct Coding {
    /// What code 0 stands for, of each coordinate.
    lows: Vec<f64>,
    /// How far apart codes are, of each coordinate; 0 only where that does not count.
    steps: Vec<f64>,
    /// Between which steps a state may be, of each coordinate: no farther than the last code where points lie beyond.
    within: Vec<[f64; 2]>,
    /// What a squared step counts, of each factor, as a part of the one that counts most.
    weights: Vec<f32>,
    /// The key that 1 stands for.
    unit: f64,
    /// What keys may be too high by.
    margin: f64,
    error: f64,
}

impl Coding {
    /// Of canonical rows; None where numbers or weights are out of range.
    pub(crate) fn of(space: &Space, points: &Points) -> Option<Self> {
        let spans = spans(points);
        // What a unit is worth in the metric, and then a step of each factor.
        let worth = |part: &Part| space.groups()[part.group].weight * part.weight.sqrt();
        let fine = |part: &Part| worth(part) * step(part, &spans);
        let finest = FINEST * space.parts().iter().map(fine).fold(0.0, f64::max);
        let (mut lows, mut steps, mut within) = (Vec::new(), Vec::new(), Vec::new());
        let mut squares = Vec::new();
        for part in space.parts() {
            let axes = part.offset..part.offset + part.factor.coordinates();
            let mut step = step(part, &spans);
            let mut square = (worth(part) * step).powi(2);
            match part.factor {
                Factor::RealVector(_) => {
                    if worth(part) > 0.0 {
                        step = step.max(finest / worth(part));
                        square = (worth(part) * step).powi(2);
                    }
                    lows.extend(spans[axes.clone()].iter().map(|span| span.low));
                    within.extend(spans[axes].iter().map(Span::within));
                }
                Factor::SO2 { period } => {
                    lows.push(-period / 2.0);
                    within.push([0.0, MOST]);
                }
                Factor::SO3 => {
                    lows.extend([-1.0; 4]);
                    within.extend([[0.0, MOST]; 4]);
                    // Cosines are not in steps.
                    square = worth(part).powi(2);
                }
            }
            steps.resize(lows.len(), step);
            squares.push(square);
        }
        let heaviest = squares.iter().copied().fold(0.0, f64::max);
        let share = |square: &f64| match square / heaviest {
            share if share < LEAST_SHARE => 0.0,
            share => share as f32,
        };
        let weights: Vec<f32> = squares.iter().map(share).collect();
        let unit = match space.groups() {
            [group] => heaviest / (group.weight * group.weight),
            _ => heaviest.sqrt(),
        };
        let roundings = space.coordinates() + 2 * space.parts().len() + 32;
        let coding = Self {
            error: error(space, &steps, &weights),
            lows,
            steps,
            within,
            weights,
            unit,
            margin: 1.0 + roundings as f64 * 2f64.powi(-24),
        };
        let in_range = UNITS.contains(&heaviest) && UNITS.contains(&unit);
        (in_range && coding.error.is_finite()).then_some(coding)
    }

    /// The code of a canonical row's number in the coordinate `axis`.
    pub(crate) fn code(&self, axis: usize, number: f64) -> u16 {
        // Rounds. (Where the step is 0 this may be no number, which makes 0.)
        ((number - self.lows[axis]) / self.steps[axis] + 0.5) as u16
    }

    /// A canonical state, to be asked about.
    pub(crate) fn ask<'a>(&'a self, space: &Space, state: &[f64]) -> Asked<'a> {
        let (mut numbers, mut products) = (Vec::with_capacity(state.len()), Vec::new());
        for part in space.parts() {
            let axes = part.offset..part.offset + part.factor.coordinates();
            let mut product = 0.0;
            for (axis, &x) in axes.clone().zip(&state[axes]) {
                let (low, step, [least, most]) =
                    (self.lows[axis], self.steps[axis], self.within[axis]);
                numbers.push(match part.factor {
                    Factor::SO3 => x * step,
                    _ if step == 0.0 => 0.0,
                    _ => ((x - low) / step).clamp(least, most),
                } as f32);
                product += x * low;
            }
            products.push(product as f32);
        }
        Asked {
            coding: self,
            numbers,
            products,
        }
    }
}

/// Where codes begin and end in a coordinate.
#[derive(Debug)]
struct Span {
    low: f64,
    high: f64,
    /// Whether points lie below and above.
    beyond: [bool; 2],
}

/// The spans of all coordinates.
fn spans(points: &Points) -> Vec<Span> {
    let width = points.coordinates();
    let mut ends = vec![(f64::INFINITY, f64::NEG_INFINITY); width];
    for point in points.iter() {
        for ((least, greatest), &x) in ends.iter_mut().zip(point.row) {
            (*least, *greatest) = (least.min(x), greatest.max(x));
        }
    }
    let sample = points.iter().step_by(points.len().div_ceil(SAMPLE).max(1));
    let sample: Vec<&[f64]> = sample.map(|point| point.row).collect();
    let spans = ends.into_iter().enumerate();
    let spans =
        spans.map(|(axis, ends)| Span::of(ends, sample.iter().map(|row| row[axis]).collect()));
    spans.collect()
}

impl Span {
    /// Of numbers from `least` to `greatest`, by a sample of them.
    fn of((least, greatest): (f64, f64), mut sample: Vec<f64>) -> Self {
        sample.sort_unstable_by(f64::total_cmp);
        let tail = sample.len() / TAIL;
        let [low, high] = [tail, sample.len() - 1 - tail].map(|at| sample[at]);
        let more = BEYOND * (high - low);
        // (Where nearly all are equal, the others are what there is to tell apart.)
        let (low, high) = match more > 0.0 {
            true => (least.max(low - more), greatest.min(high + more)),
            false => (least, greatest),
        };
        let beyond = [least < low, greatest > high];
        Self { low, high, beyond }
    }

    /// Between which steps a state may be.
    fn within(&self) -> [f64; 2] {
        let [below, above] = self.beyond;
        [
            if below { 0.0 } else { -FARTHEST },
            if above { MOST } else { FARTHEST },
        ]
    }
}

/// How far apart the codes of a factor are. Any two of its coordinates add up: they have one step.
fn step(part: &Part, spans: &[Span]) -> f64 {
    let spans = &spans[part.offset..][..part.factor.coordinates()];
    let span = match part.factor {
        Factor::RealVector(_) => spans
            .iter()
            .map(|span| span.high - span.low)
            .fold(0.0, f64::max),
        Factor::SO2 { period } => period,
        Factor::SO3 => 2.0,
    };
    span / MOST
}

/// How far a state moves whose coordinates move by [`MOVED`], but for its rotations; and what squares lose that are out of
/// range.
fn error(space: &Space, steps: &[f64], weights: &[f32]) -> f64 {
    let (mut total, mut sum_2) = (0.0, 0.0);
    for (place, part) in space.parts().iter().enumerate() {
        if weights[place] > 0.0 && part.factor != Factor::SO3 {
            let moved = MOVED * steps[part.offset] + f64::MIN_POSITIVE.sqrt();
            sum_2 += part.weight * moved * moved * part.factor.coordinates() as f64;
        }
        if part.ends_group {
            total += space.groups()[part.group].weight * sum_2.sqrt();
            sum_2 = 0.0;
        }
    }
    total * (1.0 + 1e-9)
}

/// A state in the steps of a coding.
#[derive(Debug)]
pub(crate) struct Asked<'a> {
    coding: &'a Coding,
    /// Of each coordinate, how many steps it lies above the low; of a rotation's, what a step of it adds to a cosine.
    numbers: Vec<f32>,
    /// What the lows of each factor, multiplied with the state, add to its cosines.
    products: Vec<f32>,
}

impl Asked<'_> {
    /// No point has moved farther than this, but by its rotations.
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
        Kernels,
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
            let (scale, asked) = (Scale::new(&space), coding.ask(&space, &query));
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
