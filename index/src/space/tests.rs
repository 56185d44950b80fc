//! Properties of distances that the structures rely on. The bounds are tested with the kernels.

use super::{Factor, Group, Space, Term};
use proptest::prelude::*;

/// The configuration of property tests: `cases` cases, the same in every run.
pub(crate) fn cases(cases: u32) -> ProptestConfig {
    ProptestConfig {
        cases,
        rng_seed: proptest::test_runner::RngSeed::Fixed(cases.into()),
        failure_persistence: None,
        ..Default::default()
    }
}

#[test]
fn parts_follow_the_row() {
    let space: Space = "sum(R2*SO3:0.15, SO2:3, R1:0)".parse().unwrap();
    let parts: Vec<_> = space
        .parts()
        .iter()
        .map(|part| (part.factor, part.offset, part.weight, part.group))
        .collect();
    assert_eq!(
        parts,
        [
            (Factor::RealVector(2), 0, 1.0, 0),
            (Factor::SO3, 2, 0.15, 0),
            (Factor::so2(), 6, 1.0, 1),
            (Factor::RealVector(1), 7, 0.0, 2), // nothing counts in a group that does not
        ]
    );
}

#[test]
fn no_distance_is_nan_where_squares_overflow() {
    let heavy = |weight| Group {
        weight,
        terms: vec![Term {
            factor: Factor::RealVector(1),
            weight: 1e200,
        }],
    };
    let space = Space::new(vec![heavy(0.0), heavy(1.0)]).unwrap();
    let ([zero, one], far) = ([[0.0, 0.0], [1e150, 0.0]], [0.0, 1e150]);
    assert_eq!(space.distance(&zero, &one), 0.0);
    assert_eq!(space.distance(&zero, &far), f64::INFINITY);
}

#[test]
fn the_least_differences_count_as_0_or_less_exactly() {
    let space: Space = "R1".parse().unwrap();
    let distance = |difference| space.distance(&[0.0], &[difference]);
    assert_eq!(distance(1.5e-154), 1.5e-154);
    assert!((distance(1e-155) - 1e-155).abs() < 1e-165);
    assert_ne!(distance(2e-162), 0.0);
    assert_ne!(distance(2e-162), 2e-162);
    assert_eq!(distance(1.5e-162), 0.0);
}

/// The row of 14 numbers as a state of the space, its quaternions brought to length 1.
fn state(space: &Space, mut row: Vec<f64>) -> Vec<f64> {
    for part in space.parts() {
        if part.factor == Factor::SO3 {
            let q = &mut row[part.offset..part.offset + 4];
            let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            q.iter_mut().for_each(|x| *x /= norm);
        }
    }
    space.canonicalize(&mut row).unwrap();
    row
}

proptest! {
    #![proptest_config(cases(1000))]

    #[test]
    fn distance_composes_the_weighted_sums(
        a in prop::collection::vec(0.5..3.0, 14),
        b in prop::collection::vec(-3.0..-0.5, 14),
        text in prop::sample::select(&[
            "R14", "R10:7*SO2:0.3^4", "(R3*SO3:0.15)^2", "sum(R1^14)", "sum((R3*SO3:0.15)^2)",
            "sum(R2:0.1, SO3*SO2:7^2, R2:0.15^3)", "sum(R6:0, SO3:2^2)",
        ][..]),
    ) {
        let space: Space = text.parse().unwrap();
        let (a, b) = (state(&space, a), state(&space, b));
        let mut sums_2 = vec![0.0; space.groups().len()];
        for part in space.parts() {
            sums_2[part.group] += part.weight * part.distance_2(&a, &b);
        }
        let mut total = 0.0;
        for (group, sum_2) in space.groups().iter().zip(sums_2) {
            total += group.weight * f64::sqrt(sum_2);
        }
        prop_assert_eq!(f64::to_bits(total), space.distance(&a, &b).to_bits());
    }
}
