//! The 16-bit codes of some points: for each coordinate, the number of steps above a low.
//!
//! A few points may lie far from all others. So codes end near the others, and points beyond an end have its code. No
//! point gets farther from a query by that, since a query beyond the same end is moved to it too.

use std::iter::repeat_n;

use crate::{Factor, Points, Space, boxes::around_rows, space::Part};

/// The greatest code.
pub(super) const MAX_CODE: f64 = u16::MAX as f64;

/// The steps by which a coordinate may have moved: half of one, and the error of a difference (see `query`).
const MAX_MOVED: f64 = 0.52;

/// The farthest step outside the codes at which a query may lie; a query farther out is moved there, which is nearer.
/// The square of that many steps is in range.
const MAX_QUERY_STEPS: f64 = (1_u64 << 50) as f64;

/// The least length of a step in the metric, as a share of the longest step. A finer one tells points apart no better,
/// and would put the other points out of reach where all points coincide in a factor.
const MIN_STEP_SHARE: f64 = 1e-3;

/// A factor whose squared step has less than this share of the heaviest one is left out.
const MIN_WEIGHT_SHARE: f64 = 1e-30;

/// The squared steps and keys that 1 may stand for; beyond them products may be out of range.
const UNITS: std::ops::Range<f64> = 1e-200..1e200;

/// The maximum number of points sampled to find where most points lie: between the ends that remain without a share of
/// 1 / [`TAIL_DIVISOR`] on either side ...
const MAX_SAMPLE_ROWS: usize = 512;
const TAIL_DIVISOR: usize = 50;

/// ... and beyond them by this share of the distance between those ends.
const MARGIN_SHARE: f64 = 1.0;

/// The meaning of the codes of some points.
#[derive(Clone, Debug)]
pub(crate) struct Quantizer {
    /// For each coordinate, the number that code 0 stands for.
    pub(super) lows: Vec<f64>,
    /// For each coordinate, the distance between codes; 0 only where the coordinate does not count.
    pub(super) steps: Vec<f64>,
    /// For each coordinate, the steps between which a query may lie: up to the last code if points lie beyond it.
    pub(super) query_range: Vec<[f64; 2]>,
    /// For each factor, the weight of a squared step as a share of the heaviest one.
    pub(super) weights: Vec<f32>,
    /// The key that 1 stands for.
    pub(super) unit: f64,
    /// The factor by which keys may be too high.
    pub(super) margin: f64,
    /// The greatest distance that a point has moved, apart from its rotations and from beyond an end.
    pub(super) error: f64,
}

impl Quantizer {
    /// The quantizer for canonical rows, at least one; None where numbers or weights are out of range, or all numbers
    /// that count are equal.
    pub(crate) fn of(space: &Space, points: &Points) -> Option<Self> {
        let spans = spans(points);
        let length = |part: &Part| part.unit_length * step(part, &spans);
        let longest = space.parts().iter().map(length).fold(0.0, f64::max);
        let min_length = MIN_STEP_SHARE * longest;
        let (mut lows, mut steps, mut query_range) = (Vec::new(), Vec::new(), Vec::new());
        let mut squares = Vec::new();
        for part in space.parts() {
            let mut step = step(part, &spans);
            match part.factor.span() {
                None => {
                    if part.unit_length > 0.0 {
                        step = step.max(min_length / part.unit_length);
                    }
                    lows.extend(spans[part.axes()].iter().map(|span| span.low));
                    query_range.extend(spans[part.axes()].iter().map(Span::query_range));
                }
                Some((low, _)) => {
                    let coordinates = part.factor.coordinates();
                    lows.extend(repeat_n(low, coordinates));
                    query_range.extend(repeat_n([0.0, MAX_CODE], coordinates));
                }
            }
            steps.resize(lows.len(), step);
            // Cosines are not in steps.
            let unit = if part.factor == Factor::SO3 {
                1.0
            } else {
                step
            };
            squares.push((part.unit_length * unit).powi(2));
        }
        let heaviest = squares.iter().copied().fold(0.0, f64::max);
        let share = |square: &f64| match square / heaviest {
            share if share < MIN_WEIGHT_SHARE => 0.0,
            share => share as f32,
        };
        let weights: Vec<f32> = squares.iter().map(share).collect();
        let unit = match space.groups() {
            [group] => heaviest / (group.weight * group.weight),
            _ => heaviest.sqrt(),
        };
        let roundings = space.coordinates() + 2 * space.parts().len() + 32;
        let quantizer = Self {
            error: error(space, &steps, &weights),
            lows,
            steps,
            query_range,
            weights,
            unit,
            margin: 1.0 + roundings as f64 * 2f64.powi(-24),
        };
        let in_range = UNITS.contains(&heaviest) && UNITS.contains(&unit);
        (in_range && quantizer.error.is_finite()).then_some(quantizer)
    }

    /// The code of a number of a canonical row in the coordinate `axis`.
    pub(crate) fn code(&self, axis: usize, number: f64) -> u16 {
        // The cast rounds to the nearest code. (A step of 0 may make a NaN, whose code is 0.)
        ((number - self.lows[axis]) / self.steps[axis] + 0.5) as u16
    }
}

/// The numbers between which codes lie in a coordinate.
#[derive(Debug)]
struct Span {
    low: f64,
    high: f64,
    /// True if points lie below and above.
    beyond: [bool; 2],
}

/// The spans of all coordinates.
fn spans(points: &Points) -> Vec<Span> {
    let (lo, hi) = around_rows(points.coordinates(), points.iter().map(|point| point.row));
    let sample = points
        .iter()
        .step_by(points.len().div_ceil(MAX_SAMPLE_ROWS).max(1));
    let sample: Vec<&[f64]> = sample.map(|point| point.row).collect();
    let column = |axis: usize| sample.iter().map(|row| row[axis]).collect();
    let spans = lo.into_iter().zip(hi).enumerate();
    spans
        .map(|(axis, ends)| Span::of(ends, column(axis)))
        .collect()
}

impl Span {
    /// The span of numbers from `least` to `greatest`, by a sample of them.
    fn of((least, greatest): (f64, f64), mut sample: Vec<f64>) -> Self {
        sample.sort_unstable_by(f64::total_cmp);
        let tail = sample.len() / TAIL_DIVISOR;
        let [low, high] = [tail, sample.len() - 1 - tail].map(|at| sample[at]);
        let more = MARGIN_SHARE * (high - low);
        // (Where nearly all numbers are equal, the others are the ones to tell apart.)
        let (low, high) = match more > 0.0 {
            true => (least.max(low - more), greatest.min(high + more)),
            false => (least, greatest),
        };
        let beyond = [least < low, greatest > high];
        Self { low, high, beyond }
    }

    /// The steps between which a query may lie. If no point lies beyond an end, no point has its code for another
    /// number, because all lie within `MAX_CODE` steps, also of wider ones; if some do, they and the query get the same
    /// code.
    fn query_range(&self) -> [f64; 2] {
        let [below, above] = self.beyond;
        [
            if below { 0.0 } else { -MAX_QUERY_STEPS },
            if above { MAX_CODE } else { MAX_QUERY_STEPS },
        ]
    }
}

/// The distance between the codes of a factor, the same in all its coordinates, since their squares are added.
fn step(part: &Part, spans: &[Span]) -> f64 {
    let length = match part.factor.span() {
        None => spans[part.axes()]
            .iter()
            .map(|span| span.high - span.low)
            .fold(0.0, f64::max),
        Some((_, length)) => length,
    };
    length / MAX_CODE
}

/// The distance that a state moves if its coordinates, apart from rotations, move by [`MAX_MOVED`], and the loss of
/// squares that are out of range.
fn error(space: &Space, steps: &[f64], weights: &[f32]) -> f64 {
    let (mut total, mut sum_2) = (0.0, 0.0);
    for (part_index, part) in space.parts().iter().enumerate() {
        if weights[part_index] > 0.0 && part.factor != Factor::SO3 {
            let moved = MAX_MOVED * steps[part.offset] + f64::MIN_POSITIVE.sqrt();
            sum_2 += part.weight * moved * moved * part.factor.coordinates() as f64;
        }
        if part.ends_group {
            total += space.groups()[part.group].weight * sum_2.sqrt();
            sum_2 = 0.0;
        }
    }
    total * (1.0 + 1e-9)
}
