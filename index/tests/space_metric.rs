//! The axioms of a metric, factor by factor and composed: non-negativity, identity, symmetry to the bit, the triangle
//! inequality, and equal distances of identified states.

#![expect(clippy::unwrap_used, reason = "a test stops where its helper fails")]

use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use std::f64::consts::FRAC_PI_2;
use wayfold_index::{Factor, Space};

/// Every factor, products and sums of them, and a weight of 0.
const SPACES: [&str; 14] = [
    "R1",
    "R6",
    "SO2",
    "SO2[1]",
    "SO2[1e-3]",
    "SO3",
    "R2*SO2",
    "R3*SO3:0.15",
    "R3*SO3:15",
    "sum(R3, SO3)",
    "SO2^6",
    "sum((SO2^2), R3)",
    "R2:0*SO2",
    "(R3*RP3:0.15)^2",
];

fn cases(cases: u32) -> ProptestConfig {
    ProptestConfig {
        cases,
        rng_seed: RngSeed::Fixed(cases.into()),
        failure_persistence: None,
        ..Default::default()
    }
}

/// Factors of a space with the first coordinate of each.
fn factors(space: &Space) -> Vec<(usize, Factor)> {
    let mut offset = 0;
    let terms = space.groups().iter().flat_map(|group| &group.terms);
    terms
        .map(|term| {
            let at = offset;
            offset += term.factor.coordinates();
            (at, term.factor)
        })
        .collect()
}

/// Any 16 numbers as a state: angles of some turns, quaternions of any direction.
fn state(space: &Space, numbers: &[f64]) -> Vec<f64> {
    let mut row = numbers[..space.coordinates()].to_vec();
    for (at, factor) in factors(space) {
        if factor == Factor::SO3 {
            let q = &mut row[at..at + 4];
            let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            if norm < 1e-3 {
                q.copy_from_slice(&[0.0, 0.0, 0.0, 1.0]);
            } else {
                q.iter_mut().for_each(|x| *x /= norm);
            }
        }
    }
    space.canonicalize(&mut row).unwrap();
    row
}

/// Three triples of numbers: apart, or within 1e-3 to 1e-9 of each other.
fn triples() -> impl Strategy<Value = [Vec<f64>; 3]> {
    let numbers = || prop::collection::vec(-4.0..4.0, 16);
    let spread = prop_oneof![Just(1.0), Just(1e-3), Just(1e-6), Just(1e-9)];
    (numbers(), numbers(), numbers(), spread).prop_map(|(a, b, c, spread)| {
        let near = |other: Vec<f64>| a.iter().zip(other).map(|(x, y)| x + spread * y).collect();
        let (b, c) = (near(b), near(c));
        [a, b, c]
    })
}

proptest! {
    #![proptest_config(cases(2000))]

    #[test]
    fn is_non_negative_and_zero_from_a_state_to_itself(numbers in triples()) {
        for space in SPACES.map(|text| text.parse::<Space>().unwrap()) {
            let [a, b, _] = numbers.each_ref().map(|row| state(&space, row));
            let d = space.distance(&a, &b);
            prop_assert!(d >= 0.0 && d.is_finite(), "{}", space);
            prop_assert_eq!(space.distance(&a, &a).to_bits(), 0.0_f64.to_bits(), "{}", space);
        }
    }

    #[test]
    fn tells_different_states_apart(numbers in triples()) {
        for space in SPACES.map(|text| text.parse::<Space>().unwrap()) {
            let weightless = space.groups().iter().any(|group| group.terms.iter().any(|t| t.weight == 0.0));
            let [a, b, _] = numbers.each_ref().map(|row| state(&space, row));
            if a != b && !weightless {
                prop_assert!(space.distance(&a, &b) > 0.0, "{}", space);
            }
        }
    }

    #[test]
    fn is_symmetric_to_the_bit(numbers in triples()) {
        for space in SPACES.map(|text| text.parse::<Space>().unwrap()) {
            let [a, b, _] = numbers.each_ref().map(|row| state(&space, row));
            let (there, back) = (space.distance(&a, &b), space.distance(&b, &a));
            prop_assert_eq!(there.to_bits(), back.to_bits(), "{}", space);
        }
    }

    #[test]
    fn keeps_the_triangle_inequality(numbers in triples()) {
        for space in SPACES.map(|text| text.parse::<Space>().unwrap()) {
            let [a, b, c] = numbers.each_ref().map(|row| state(&space, row));
            let (direct, round) =
                (space.distance(&a, &c), space.distance(&a, &b) + space.distance(&b, &c));
            prop_assert!(direct <= round * (1.0 + 1e-12), "{}: {} > {}", space, direct, round);
        }
    }

    #[test]
    fn identifies_a_quaternion_with_its_negative(numbers in triples()) {
        let space: Space = "SO3".parse().unwrap();
        let [a, b, _] = numbers.map(|row| state(&space, &row));
        let negative: Vec<f64> = b.iter().map(|x| -x).collect();
        // Both the distance itself and the canonical form treat b and −b alike.
        let d = space.distance(&a, &b);
        prop_assert_eq!(d.to_bits(), space.distance(&a, &negative).to_bits());
        let mut canonical = negative;
        space.canonicalize(&mut canonical).unwrap();
        prop_assert_eq!(&canonical, &b);
        prop_assert!(d <= FRAC_PI_2);
    }

    #[test]
    fn identifies_an_angle_with_those_some_turns_away(
        // Multiples of 2⁻²⁰, so that adding a period of 1 is exact.
        a in -(1 << 20)..1_i32 << 20,
        b in -(1 << 20)..1_i32 << 20,
        turns in -1000..1000_i32,
    ) {
        let space: Space = "SO2[1]".parse().unwrap();
        let unit = f64::from(1 << 20).recip();
        let [mut a, mut b] = [a, b].map(|x| [f64::from(x) * unit]);
        let mut turned = [b[0] + f64::from(turns)];
        for row in [&mut a, &mut b, &mut turned] {
            space.canonicalize(row).unwrap();
        }
        prop_assert_eq!(b, turned);
        prop_assert!(space.distance(&a, &b) <= 0.5);
    }

    #[test]
    fn a_circle_is_at_most_half_its_period_wide(numbers in triples()) {
        for (text, period) in [("SO2", std::f64::consts::TAU), ("SO2[1]", 1.0), ("SO2[1e-3]", 1e-3)] {
            let space: Space = text.parse().unwrap();
            let [a, b, _] = numbers.each_ref().map(|row| state(&space, row));
            prop_assert!(space.distance(&a, &b) <= period / 2.0);
        }
    }
}

#[test]
fn the_seam_is_no_gap() {
    // A step of 2⁻⁴⁰ across ±P/2, and across w = 0 between q and −q.
    let step = (1_u64 << 40) as f64;
    let step = step.recip();
    let circle: Space = "SO2[1]".parse().unwrap();
    assert_eq!(circle.distance(&[-0.5], &[0.5 - step]), step);
    let rotations: Space = "SO3".parse().unwrap();
    let (mut a, mut b) = ([0.6, 0.8, 0.0, step], [0.6, 0.8, 0.0, -step]);
    rotations.canonicalize(&mut a).unwrap();
    rotations.canonicalize(&mut b).unwrap();
    assert_eq!(b, [-0.6, -0.8, 0.0, step]);
    let d = rotations.distance(&a, &b);
    assert!((d - 2.0 * step).abs() <= 1e-15 * d, "{d:e}");
}
