//! A scan of every point, the lower limit in many dimensions. The coordinates of neighbouring points are interleaved in
//! memory, so that the compiler computes several bounds at once. It is exact: the space's own distance is computed for
//! the points that pass the bound.

use wayfold_index::{Factor, Space};

use super::Structure;

/// The number of points of a block. Their coordinates are interleaved, and their bounds fit into the registers of a
/// CPU.
const LANES: usize = 32;

/// The greatest relative excess of a bound over its quantity: some dozens of roundings.
const MARGIN: f64 = 1e-13;

/// The maximum rounding error of a chord's square, which is of order 1.
const CHORD_MARGIN: f64 = 4e-15;

/// θ² ≥ s · (1 + s/12 + s²/90 + s³/560) for the angle θ of the squared chord s: the rest of the series is positive.
const SERIES: [f64; 3] = [1.0 / 12.0, 1.0 / 90.0, 1.0 / 560.0];

type Lanes = [f64; LANES];

/// A table of points in blocks of [`LANES`], a block's first coordinates first.
pub struct Scan {
    space: Space,
    blocks: Vec<Lanes>,
    points: usize,
    row: Vec<f64>,
    /// The answers, by (distance, id).
    held: Vec<(f64, u32)>,
}

impl Scan {
    pub fn new(space: &Space) -> Self {
        Scan {
            row: vec![0.0; space.coordinates()],
            space: space.clone(),
            blocks: Vec::new(),
            points: 0,
            held: Vec::new(),
        }
    }

    /// Offers every point that may be within the bound; `offer` returns the new bound.
    fn scan(
        &mut self,
        query: &[f64],
        mut bound: f64,
        mut offer: impl FnMut(&mut Vec<(f64, u32)>, f64, u32) -> f64,
    ) {
        let is_squared = self.space.groups().len() == 1;
        let limit = |bound: f64| {
            let key = if is_squared { bound * bound } else { bound };
            key * (1.0 + MARGIN)
        };
        let mut most = limit(bound);
        let width = self.space.coordinates();
        for (at, block) in self.blocks.chunks_exact(width).enumerate() {
            let keys = keys(&self.space, is_squared, query, block);
            // Without a branch, the compiler does this for all lanes at once.
            let mut any = false;
            for key in &keys {
                any |= *key <= most;
            }
            if !any {
                continue;
            }
            let first = at * LANES;
            let lanes = LANES.min(self.points - first);
            for (lane, key) in keys[..lanes].iter().enumerate() {
                if *key <= most {
                    for (x, column) in self.row.iter_mut().zip(block) {
                        *x = column[lane];
                    }
                    let distance = self.space.distance(query, &self.row);
                    if distance <= bound {
                        bound = offer(&mut self.held, distance, (first + lane) as u32);
                        most = limit(bound);
                    }
                }
            }
        }
    }

    fn report(&mut self, found: &mut Vec<u32>) {
        found.clear();
        found.extend(self.held.drain(..).map(|(_, id)| id));
    }
}

/// Lower bounds of the distances of the query to the points of a block: squared if the space is one group.
#[inline]
fn keys(space: &Space, is_squared: bool, query: &[f64], block: &[Lanes]) -> Lanes {
    let mut total = [0.0; LANES];
    let mut at = 0;
    for group in space.groups() {
        let mut sum_2 = [0.0; LANES];
        for term in &group.terms {
            let own = at..at + term.factor.coordinates();
            at = own.end;
            let (query, block) = (&query[own.clone()], &block[own]);
            match term.factor {
                Factor::RealVector(_) => add_straight(&mut sum_2, term.weight, query, block),
                Factor::SO2 { period } => {
                    add_arc(&mut sum_2, term.weight, period, query[0], &block[0]);
                }
                Factor::SO3 => add_rotation(&mut sum_2, term.weight, query, block),
            }
        }
        if is_squared {
            return sum_2;
        }
        for (total, sum_2) in total.iter_mut().zip(&sum_2) {
            *total += group.weight * sum_2.sqrt();
        }
    }
    total
}

/// a·b + c, rounded once.
#[inline(always)]
#[expect(
    clippy::disallowed_methods,
    reason = "only bounds, which have a margin"
)]
fn fused(a: f64, b: f64, c: f64) -> f64 {
    a.mul_add(b, c)
}

#[inline]
fn add_straight(sum_2: &mut Lanes, weight: f64, query: &[f64], block: &[Lanes]) {
    let mut own = [0.0; LANES];
    for (q, column) in query.iter().zip(block) {
        for (sum, x) in own.iter_mut().zip(column) {
            let d = x - q;
            *sum = fused(d, d, *sum);
        }
    }
    for (sum, own) in sum_2.iter_mut().zip(&own) {
        *sum = fused(weight, *own, *sum);
    }
}

#[inline]
fn add_arc(sum_2: &mut Lanes, weight: f64, period: f64, q: f64, column: &Lanes) {
    for (sum, x) in sum_2.iter_mut().zip(column) {
        let d = (x - q).abs();
        let arc = if d < period - d { d } else { period - d };
        *sum = fused(weight * arc, arc, *sum);
    }
}

#[inline]
fn add_rotation(sum_2: &mut Lanes, weight: f64, query: &[f64], block: &[Lanes]) {
    let mut dot = [0.0; LANES];
    for (q, column) in query.iter().zip(block) {
        for (dot, x) in dot.iter_mut().zip(column) {
            *dot = fused(*x, *q, *dot);
        }
    }
    let [c1, c2, c3] = SERIES;
    for (sum, dot) in sum_2.iter_mut().zip(&dot) {
        // |a ∓ b|² = 2 − 2|a·b|.
        let s = fused(-2.0, dot.abs(), 2.0 - CHORD_MARGIN);
        let s = if s > 0.0 { s } else { 0.0 };
        let series = fused(s, fused(s, fused(s, c3, c2), c1), 1.0);
        *sum = fused(weight * s, series, *sum);
    }
}

impl Structure for Scan {
    fn nearest(&mut self, query: &[f64], k: usize, found: &mut Vec<u32>) {
        self.held.clear();
        self.scan(query, f64::INFINITY, |held, distance, id| {
            let after = held.partition_point(|near| *near < (distance, id));
            held.insert(after, (distance, id));
            held.truncate(k);
            if held.len() < k {
                f64::INFINITY
            } else {
                held[k - 1].0
            }
        });
        self.report(found);
    }

    fn within(&mut self, query: &[f64], radius: f64, found: &mut Vec<u32>) {
        self.held.clear();
        self.scan(query, radius, |held, distance, id| {
            held.push((distance, id));
            radius
        });
        self.report(found);
    }

    fn insert(&mut self, row: &[f64]) {
        let (block, lane) = (self.points / LANES, self.points % LANES);
        if lane == 0 {
            let blocks = self.blocks.len() + row.len();
            self.blocks.resize(blocks, [0.0; LANES]);
        }
        for (column, x) in self.blocks[block * row.len()..].iter_mut().zip(row) {
            column[lane] = *x;
        }
        self.points += 1;
    }
}
