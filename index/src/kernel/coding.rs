//! What codes of sixteen bits mean: of each coordinate, how many steps a number lies above the least.
//!
//! Few points may lie far from all others: codes end not far from the others, and points beyond stand at the end. That
//! brings none farther from a state that is brought to the same end.

use crate::{Factor, Points, Space, space::Part};

/// The greatest code.
pub(super) const MOST: f64 = u16::MAX as f64;

/// How far a coordinate may have moved, in steps: by half of one, and by more than a difference is off by (see
/// `coded`).
const MOVED: f64 = 0.52;

/// A state that lies farther outside counts as if it lay here, which is nearer: so many steps have a square in range.
const FARTHEST: f64 = (1_u64 << 50) as f64;

/// No step need be worth less than this part of another: that would tell nothing more, and of points that lie at one place
/// in a factor, any other place would be out of reach.
const FINEST: f64 = 1e-3;

/// A factor whose squared step counts less than this part of the one that counts most is left out.
const LEAST_SHARE: f64 = 1e-30;

/// The squared steps, and the keys, that 1 may stand for: with others, products may be out of range.
const UNITS: std::ops::Range<f64> = 1e-200..1e200;

/// So many points tell where the others lie: between those that remain when a fiftieth is left out on either side, ...
const SAMPLE: usize = 512;
const TAIL: usize = 50;

/// ... and beyond by so many times the distance between those.
const BEYOND: f64 = 1.0;

/// What the codes of some points mean.
#[derive(Clone, Debug)]
pub(crate) struct Coding {
    /// What code 0 stands for, of each coordinate.
    pub(super) lows: Vec<f64>,
    /// How far apart codes are, of each coordinate; 0 only where that does not count.
    pub(super) steps: Vec<f64>,
    /// Between which steps a state may be, of each coordinate: no farther than the last code where points lie beyond.
    pub(super) within: Vec<[f64; 2]>,
    /// What a squared step counts, of each factor, as a part of the one that counts most.
    pub(super) weights: Vec<f32>,
    /// The key that 1 stands for.
    pub(super) unit: f64,
    /// What keys may be too high by.
    pub(super) margin: f64,
    /// No point has moved farther than this, but by its rotations, and to an end from beyond it.
    pub(super) error: f64,
}

impl Coding {
    /// Of canonical rows, of which there is one at least; None where numbers or weights are out of range, or
    /// all numbers that count are equal.
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
            match part.factor {
                Factor::RealVector(_) => {
                    if worth(part) > 0.0 {
                        step = step.max(finest / worth(part));
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
                }
            }
            steps.resize(lows.len(), step);
            // Cosines are not in steps.
            let unit = if part.factor == Factor::SO3 {
                1.0
            } else {
                step
            };
            squares.push((worth(part) * unit).powi(2));
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

    /// Between which steps a state may be. Where no point lies beyond, none stands at that end for another, since all lie
    /// within `MOST` steps, also of wider ones; where some do, they and the state are brought to the same code.
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
