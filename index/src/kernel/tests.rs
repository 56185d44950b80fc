//! Each kernel against the distance itself, and against its portable twin, in random spaces.

use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{BLOCK_ROWS, Isa, KeyMap, MAX_CHILDREN, Measurement, Task};
use crate::{Factor, Group, Kernels, Space, Term, space::tests::cases};

const WEIGHTS: [f64; 6] = [1.0, 0.15, 15.0, 1e-3, 0.0, 2.0];

/// A state, and the ends of boxes or the columns of a block, with a limit.
struct OfBoxes<'a>(&'a Space, &'a [f64], &'a [f64], f64);
struct OfPoints<'a>(&'a Space, &'a [f64], &'a [f64], f64);

impl Task for OfBoxes<'_> {
    type Output = ([f64; MAX_CHILDREN], u32);

    #[inline(always)]
    fn run<I: Isa>(self) -> Self::Output {
        super::boxes::<I>(self.0, self.1, self.2, self.3)
    }
}

impl Task for OfPoints<'_> {
    type Output = ([f64; BLOCK_ROWS], u32);

    #[inline(always)]
    fn run<I: Isa>(self) -> Self::Output {
        super::points::<I>(self.0, self.1, self.2, self.3)
    }
}

/// A space of one to three groups of one to three factors.
pub(crate) fn space(rng: &mut ChaCha8Rng) -> Space {
    let group = |rng: &mut ChaCha8Rng| Group {
        weight: WEIGHTS[rng.random_range(0..6)],
        terms: (0..rng.random_range(1..=3))
            .map(|_| Term {
                factor: match rng.random_range(0..4) {
                    0 => Factor::so2(),
                    1 => Factor::SO2 { period: 1.0 },
                    2 => Factor::SO3,
                    _ => Factor::RealVector(rng.random_range(1..5)),
                },
                weight: WEIGHTS[rng.random_range(0..6)],
            })
            .collect(),
    };
    let mut groups: Vec<Group> = (0..rng.random_range(1..=3)).map(|_| group(rng)).collect();
    (groups[0].weight, groups[0].terms[0].weight) = (1.0, 0.7);
    Space::new(groups).unwrap()
}

/// A canonical state; with `near`, one at about a distance from another, also across seams and signs.
fn state(space: &Space, near: Option<(&[f64], f64)>, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let mut row = Vec::new();
    for part in space.parts() {
        let at = row.len();
        let axes = part.factor.coordinates();
        row.extend((0..axes).map(|_| rng.random_range(-1.0..1.0)));
        if let Some((centre, spread)) = near {
            for (x, c) in row[at..].iter_mut().zip(&centre[at..]) {
                *x = c + spread * *x;
            }
        }
        match part.factor {
            Factor::RealVector(_) => {}
            Factor::SO2 { period } if near.is_none() => {
                // The seam is where an interval is wrong about a circle.
                row[at] *= period * if rng.random() { 0.5 } else { 0.500_01 };
            }
            Factor::SO2 { .. } => {}
            Factor::SO3 => {
                if near.is_none() && rng.random() {
                    row[at + 3] *= 1e-3; // where signs change
                }
                let norm = row[at..].iter().map(|x| x * x).sum::<f64>().sqrt();
                row[at..].iter_mut().for_each(|x| *x /= norm);
            }
        }
    }
    space.canonicalize(&mut row).unwrap();
    row
}

/// A state and `count` canonical rows, clustered or spread, near the state or far from it.
pub(crate) fn scene(
    space: &Space,
    count: usize,
    rng: &mut ChaCha8Rng,
) -> (Vec<f64>, Vec<Vec<f64>>) {
    let query = state(space, None, rng);
    let other = state(space, None, rng);
    let centre = if rng.random() { &query } else { &other };
    let spread = [1.0, 0.1, 1e-3, 1e-6, 1e-9, 1e-15, 0.0][rng.random_range(0..7)];
    let rows = (0..count)
        .map(|_| state(space, Some((centre, spread)), rng))
        .collect();
    (query, rows)
}

fn columns(rows: &[Vec<f64>]) -> Vec<f64> {
    let axes = 0..rows[0].len();
    axes.flat_map(|axis| (0..BLOCK_ROWS).map(move |lane| rows[lane][axis]))
        .collect()
}

proptest! {
    #![proptest_config(cases(4000))]

    #[test]
    fn no_point_is_beyond_its_distance(seed: u64) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let space = space(&mut rng);
        let key_map = KeyMap::new(&space);
        let (query, rows) = scene(&space, BLOCK_ROWS, &mut rng);
        let columns = columns(&rows);
        let mut portable = None;
        for kernels in Kernels::available() {
            let (keys, within) = kernels.run(OfPoints(&space, &query, &columns, f64::INFINITY));
            prop_assert_eq!(within, (1 << BLOCK_ROWS) - 1);
            prop_assert_eq!(keys.map(f64::to_bits), *portable.get_or_insert(keys.map(f64::to_bits)));
            let measured = kernels.run(Measurement { space: &space, state: &query, columns: &columns });
            for (lane, row) in rows.iter().enumerate() {
                let distance = space.distance(&query, row);
                prop_assert_eq!(measured[lane].to_bits(), distance.to_bits(), "{}", space);
                prop_assert!(keys[lane] <= key_map.limit(distance), "{} {} {}", space, keys[lane], distance);
                // A bound is low by no more than the slack of a rotation and the end of its series.
                let low = key_map.limit(0.99 * distance - 1e-5);
                prop_assert!(keys[lane] >= low, "{} {} {}", space, keys[lane], distance);
                // No point as near has a key above the upper bound, which is not much greater than it has to be.
                let bound = key_map.upper_bound(keys[lane]);
                prop_assert!(bound >= key_map.limit(distance), "{} {} {}", space, bound, distance);
                let far = key_map.limit(1.01 * distance + 1e-4);
                prop_assert!(bound <= far, "{} {} {}", space, bound, distance);
                if let Some(exact) = key_map.distance(keys[lane]) {
                    prop_assert_eq!(exact.to_bits(), distance.to_bits());
                }
            }
            for limit in keys {
                let (_, within) = kernels.run(OfPoints(&space, &query, &columns, limit));
                let expected = (0..BLOCK_ROWS).filter(|&lane| keys[lane] <= limit);
                prop_assert_eq!(within, expected.map(|lane| 1 << lane).sum::<u32>());
            }
        }
    }

    #[test]
    fn no_box_is_beyond_its_points(seed: u64, points in 1..5usize) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let space = space(&mut rng);
        let key_map = KeyMap::new(&space);
        let (query, rows) = scene(&space, MAX_CHILDREN * points, &mut rng);
        let children: Vec<&[Vec<f64>]> = rows.chunks(points).collect();
        let end = |axis: usize, start: f64, pick: fn(f64, f64) -> f64| {
            let end = move |rows: &[Vec<f64>]| rows.iter().map(|row| row[axis]).fold(start, pick);
            children.iter().map(|rows| end(rows)).collect::<Vec<f64>>()
        };
        let mut ends = Vec::new();
        for axis in 0..space.coordinates() {
            ends.extend(end(axis, f64::INFINITY, f64::min));
            ends.extend(end(axis, f64::NEG_INFINITY, f64::max));
        }
        let mut portable = None;
        for kernels in Kernels::available() {
            let (keys, within) = kernels.run(OfBoxes(&space, &query, &ends, f64::INFINITY));
            prop_assert_eq!(within, (1 << MAX_CHILDREN) - 1);
            prop_assert_eq!(keys.map(f64::to_bits), *portable.get_or_insert(keys.map(f64::to_bits)));
            for (child, rows) in children.iter().enumerate() {
                for row in *rows {
                    let distance = space.distance(&query, row);
                    prop_assert!(keys[child] <= key_map.limit(distance), "{} {} {}", space, keys[child], distance);
                    if points == 1 {
                        let low = key_map.limit(0.99 * distance - 1e-12);
                        prop_assert!(keys[child] >= low, "{} {} {}", space, keys[child], distance);
                    }
                }
            }
        }
    }
}

proptest! {
    #![proptest_config(cases(50_000))]

    /// No key is beyond its distance, also where a weight makes the sum a few units of the least number, whose errors
    /// are not relative: here about half a unit decides.
    #[test]
    fn no_point_is_beyond_its_distance_among_the_least_numbers(
        units in 1..20u32,
        nudge in -4..=4i64,
        step in -9.0..-4.0_f64,
        seed: u64,
    ) {
        let space_of = |weight| {
            Space::product(vec![Term { factor: Factor::SO3, weight }]).unwrap()
        };
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let a = state(&space_of(1.0), None, &mut rng);
        let b = state(&space_of(1.0), Some((&a, 10f64.powf(step))), &mut rng);
        let chord_2: f64 = a.iter().zip(&b).map(|(x, y)| (x - y) * (x - y)).sum();
        prop_assume!(chord_2 > 0.0 && chord_2 < 1e-3);
        let weight = (f64::from(units) + 0.5) * 2f64.powi(-537) / chord_2 * 2f64.powi(-537);
        let space = space_of(f64::from_bits(weight.to_bits().saturating_add_signed(nudge)));
        let key_map = KeyMap::new(&space);
        let limit = key_map.limit(space.distance(&a, &b));
        let kernels = Kernels::default();
        let ends: Vec<f64> = b.iter().flat_map(|&x| [x; 2 * MAX_CHILDREN]).collect();
        prop_assert_eq!(kernels.run(OfBoxes(&space, &a, &ends, limit)).1, (1 << MAX_CHILDREN) - 1);
        let columns: Vec<f64> = b.iter().flat_map(|&x| [x; BLOCK_ROWS]).collect();
        let (keys, within) = kernels.run(OfPoints(&space, &a, &columns, limit));
        prop_assert_eq!(within, (1 << BLOCK_ROWS) - 1);
        prop_assert!(key_map.upper_bound(keys[0]) >= limit);
    }
}
