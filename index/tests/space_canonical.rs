//! The canonical form of states, and the states that are refused.

#![expect(clippy::unwrap_used, reason = "a test stops where its helper fails")]

use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use std::f64::consts::{PI, TAU};
use wayfold_index::{Space, StateError, StateProblem};

fn canonical<const N: usize>(space: &str, row: [f64; N]) -> Result<[f64; N], StateError> {
    let space: Space = space.parse().unwrap();
    let mut row = row;
    space.canonicalize(&mut row).map(|()| row)
}

fn bits(row: &[f64]) -> Vec<u64> {
    row.iter().map(|x| x.to_bits()).collect()
}

#[track_caller]
fn assert_canonical<const N: usize>(space: &str, row: [f64; N], expected: [f64; N]) {
    assert_eq!(bits(&canonical(space, row).unwrap()), bits(&expected));
}

#[track_caller]
fn assert_refused<const N: usize>(space: &str, row: [f64; N], message: &str) -> StateError {
    let error = canonical(space, row).unwrap_err();
    assert_eq!(error.to_string(), message);
    error
}

#[test]
fn real_vectors_stay() {
    assert_canonical("R3", [1.5, -1e150, 5e-324], [1.5, -1e150, 5e-324]);
    assert_canonical("R2", [-0.0, 0.0], [0.0, 0.0]);
}

#[test]
fn angles_are_wrapped_into_the_half_open_interval() {
    for (angle, wrapped) in [
        (0.25, 0.25),
        (-0.0, 0.0),
        (0.5, -0.5),
        (-0.5, -0.5),
        (0.75, -0.25),
        (-0.75, 0.25),
        (1.0, 0.0),
        (-1.0, 0.0),
        (1.5, -0.5),
        (-1.5, -0.5),
        (1e6 + 0.125, 0.125),
        (0.5_f64.next_down(), 0.5_f64.next_down()),
        (
            (-0.5_f64).next_down(),
            0.5_f64.next_down() - f64::EPSILON / 4.0,
        ), // −½ − 2⁻⁵³
        (1e300, 0.0), // an integer, as is every double above 2⁵³
    ] {
        assert_canonical("SO2[1]", [angle], [wrapped]);
    }
    assert_canonical("SO2", [PI], [-PI]);
    assert_canonical("SO2", [-PI], [-PI]);
    assert_canonical("SO2", [TAU], [0.0]);
    assert_canonical("SO2", [3.0], [3.0]);
    // 4 − 2π: the difference is exact, by Sterbenz's lemma.
    assert_canonical("SO2", [4.0], [4.0 - TAU]);
    assert_canonical("SO2[1e-150]", [1e-150], [0.0]);
}

#[test]
fn quaternions_get_one_sign() {
    for (q, expected) in [
        ([0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]),
        ([0.0, 0.0, 0.0, -1.0], [0.0, 0.0, 0.0, 1.0]),
        ([-0.0, 0.0, -0.0, 1.0], [0.0, 0.0, 0.0, 1.0]),
        ([0.6, 0.0, 0.0, -0.8], [-0.6, 0.0, 0.0, 0.8]),
        ([-0.6, 0.8, 0.0, 0.0], [0.6, -0.8, 0.0, 0.0]),
        ([-0.6, 0.8, 0.0, -0.0], [0.6, -0.8, 0.0, 0.0]),
        ([0.6, -0.8, 0.0, -0.0], [0.6, -0.8, 0.0, 0.0]),
        ([0.0, -0.6, -0.8, 0.0], [0.0, 0.6, 0.8, 0.0]),
        ([-0.0, -0.0, -1.0, -0.0], [0.0, 0.0, 1.0, 0.0]),
        ([1.0, 0.0, 0.0, -5e-324], [-1.0, 0.0, 0.0, 5e-324]),
    ] {
        assert_canonical("SO3", q, expected);
    }
}

#[test]
fn quaternions_are_normalised() {
    assert_canonical("SO3", [0.0, 0.0, 0.0, 1.009], [0.0, 0.0, 0.0, 1.0]);
    assert_canonical("SO3", [0.0, -0.991, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]);
    let q = canonical("SO3", [0.5, 0.5, 0.5, 0.505]).unwrap();
    let norm_2: f64 = q.iter().map(|x| x * x).sum();
    assert!((norm_2 - 1.0).abs() < 1e-15);
    assert!((q[3] / q[0] - 1.01).abs() < 1e-15);
}

#[test]
fn refusals_name_the_coordinate() {
    let (nan, infinity) = (f64::NAN, f64::INFINITY);
    assert_refused("R3", [0.0, nan, nan], "coords[1]: NaN");
    assert_refused("R3", [0.0, 1.0, -infinity], "coords[2]: infinite");
    let too_large = "coords[0]: a magnitude above 1e150, whose square could overflow";
    let error = assert_refused("R3", [-1e151, 0.0, 0.0], too_large);
    assert_eq!(error.reason, StateProblem::TooLarge);
    assert_refused("R2*SO2", [0.0, 0.0, nan], "coords[2]: NaN");
    assert_refused("R2*SO2", [0.0, 0.0, infinity], "coords[2]: infinite");
    assert_refused("R1*SO3", [0.0, 0.0, 0.0, nan, 1.0], "coords[3]: NaN");
    assert_refused(
        "R1*SO3",
        [0.0, 0.0, 0.0, 0.0, -infinity],
        "coords[4]: infinite",
    );
    // The error names NaN before the norm that it spoils.
    assert_refused("SO3", [2.0, 0.0, 0.0, nan], "coords[3]: NaN");
}

#[test]
fn refuses_quaternions_that_are_not_unit() {
    // A row of SE(3) shifted by one column.
    let error = assert_refused(
        "R3*SO3:0.15",
        [2.0, 3.0, 0.0, 0.0, 0.0, 1.0, 7.0],
        "coords[3]: the quaternion that begins here has norm 7.0710678118654755, not 1 within 1 %; \
         the usual cause is a shifted column or w first, the order is x, y, z, w",
    );
    assert_eq!(error.coordinate, 3);
    for norm in [0.0, 0.98, 0.989, 1.011, 1.02, 1e100] {
        let error = canonical("SO3", [0.0, norm, 0.0, 0.0]).unwrap_err();
        assert_eq!(error.coordinate, 0);
        assert!(
            matches!(error.reason, StateProblem::Norm(found) if (found - norm).abs() <= 1e-15 * norm)
        );
    }
    let overflowing = canonical("SO3", [0.0, 1e200, 0.0, 0.0]).unwrap_err();
    assert_eq!(overflowing.reason, StateProblem::Norm(f64::INFINITY));
}

#[test]
fn refuses_rows_of_another_width() {
    let message = "coords: 6 numbers, where a state of this space has 7";
    let error = assert_refused("R3*SO3", [0.0; 6], message);
    assert_eq!(
        error,
        StateError {
            coordinate: 6,
            reason: StateProblem::Width {
                expected: 7,
                found: 6
            }
        }
    );
    assert_eq!(canonical("R1", [0.0; 3]).unwrap_err().coordinate, 1);
    assert_refused(
        "R1",
        [],
        "coords: 0 numbers, where a state of this space has 1",
    );
}

/// The remainder computed another way: Rust's `%` is exact, and so is the last step, by Sterbenz's lemma.
fn wrapped(angle: f64, period: f64) -> f64 {
    let r = angle % period;
    let half = period / 2.0;
    let r = if r >= half {
        r - period
    } else if r < -half {
        r + period
    } else {
        r
    };
    r + 0.0
}

fn is_checked(space: &str, row: &[f64]) -> bool {
    space.parse::<Space>().unwrap().check_canonical(row).is_ok()
}

fn cases(cases: u32) -> ProptestConfig {
    ProptestConfig {
        cases,
        rng_seed: RngSeed::Fixed(cases.into()),
        failure_persistence: None,
        ..Default::default()
    }
}

proptest! {
    #![proptest_config(cases(20_000))]

    #[test]
    fn any_finite_angle_is_wrapped_exactly(
        angle in prop_oneof![
            any::<f64>(),
            -100.0..100.0,
            (-20..20_i32).prop_map(|n| f64::from(n) * PI),
            (-20..20_i32).prop_map(|n| (f64::from(n) * PI).next_up()),
        ].prop_filter("finite", |angle| angle.is_finite()),
        period in prop_oneof![Just(TAU), Just(1.0), Just(1e-150), Just(1e150), 1e-3..1e3],
    ) {
        let space: Space = format!("SO2[{period:e}]").parse().unwrap();
        let mut once = [angle];
        space.canonicalize(&mut once).unwrap();
        prop_assert!((-period / 2.0..period / 2.0).contains(&once[0]));
        prop_assert_eq!(once[0].to_bits(), wrapped(angle, period).to_bits());
        prop_assert_eq!(space.check_canonical(&[angle]).is_ok(), bits(&[angle]) == bits(&once));
        prop_assert!(space.check_canonical(&once).is_ok());
        let mut twice = once;
        space.canonicalize(&mut twice).unwrap();
        prop_assert_eq!(once[0].to_bits(), twice[0].to_bits());
    }

    /// A row passes the check if canonicalizing it changes no bit, and is refused for the same reason otherwise.
    #[test]
    fn a_row_passes_the_check_if_canonicalizing_it_changes_nothing(
        row in prop::collection::vec(
            prop_oneof![
                8 => prop::sample::select(&[0.0, 1.0, 0.6, 0.8, 0.5, -0.5, 0.25][..]),
                1 => prop::sample::select(&[-0.0, -1.0, 1e150, 2e150, 5e-324, f64::NAN, f64::INFINITY][..]),
                1 => any::<f64>(),
            ],
            6..9,
        ),
    ) {
        let space: Space = "R2*SO2[1]*SO3".parse().unwrap();
        let mut canonical = row.clone();
        match (space.canonicalize(&mut canonical), space.check_canonical(&row)) {
            (Ok(()), Ok(())) => prop_assert_eq!(bits(&row), bits(&canonical)),
            (Ok(()), Err(error)) => {
                let changed = (0..7).find(|&at| row[at].to_bits() != canonical[at].to_bits());
                prop_assert_eq!(Some(error.coordinate), changed);
                prop_assert_eq!(error.reason, StateProblem::NotCanonical);
            }
            // (A NaN does not equal itself.)
            (Err(expected), found) => {
                prop_assert_eq!(found.unwrap_err().to_string(), expected.to_string());
            }
        }
    }

    #[test]
    fn a_canonical_real_vector_is_itself(x in -1e150..1e150) {
        prop_assert_eq!(canonical("R1", [x]).unwrap()[0].to_bits(), x.to_bits());
    }
}

proptest! {
    #![proptest_config(cases(30_000))]

    #[test]
    fn normalising_twice_changes_no_bit(
        q in [-1.0..1.0, -1.0..1.0, -1.0..1.0, -1.0..1.0_f64],
        large in (0..4_usize, prop_oneof![-1.0..-0.1, 0.1..1.0]),
        small in [any::<bool>(), any::<bool>(), any::<bool>(), any::<bool>()],
        exponent in -320..0_i32,
        length in prop_oneof![Just(1.0), 0.9901..1.0099],
    ) {
        // At least one coordinate is large, and some are tiny, down to subnormal.
        let mut q: [f64; 4] =
            std::array::from_fn(|i| if small[i] { q[i] * 10_f64.powi(exponent) } else { q[i] });
        q[large.0] = large.1;
        let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
        let raw = q.map(|x| x / norm * length);
        let once = canonical("SO3", raw).unwrap();
        let twice = canonical("SO3", once).unwrap();
        prop_assert_eq!(bits(&once), bits(&twice));
        prop_assert_eq!(is_checked("SO3", &raw), bits(&raw) == bits(&once));
        prop_assert!(is_checked("SO3", &once));
        let negative = canonical("SO3", raw.map(|x| -x)).unwrap();
        prop_assert_eq!(bits(&once), bits(&negative));
        let first = [once[3], once[0], once[1], once[2]].into_iter().find(|x| *x != 0.0);
        prop_assert!(first.is_some_and(|x| x > 0.0));
        let norm_2: f64 = once.iter().map(|x| x * x).sum();
        prop_assert!((norm_2 - 1.0).abs() <= 8.0 * f64::EPSILON);
    }
}
