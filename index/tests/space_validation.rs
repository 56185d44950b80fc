//! Valid spaces, invalid spaces, and equal spaces.

#![expect(clippy::unwrap_used, reason = "a test stops where its helper fails")]

use wayfold_index::{Factor, Group, Space, SpaceError, Term};

const R1: Factor = Factor::RealVector(1);

fn term(factor: Factor, weight: f64) -> Term {
    Term { factor, weight }
}

fn group(weight: f64, terms: &[Term]) -> Group {
    let terms = terms.to_vec();
    Group { weight, terms }
}

#[track_caller]
fn assert_refused(groups: Vec<Group>, message: &str) {
    assert_eq!(Space::new(groups).unwrap_err().to_string(), message);
}

#[test]
fn a_space_has_groups_and_a_group_terms() {
    assert_refused(vec![], "a space needs at least one factor, as in R3");
    assert_refused(
        vec![group(1.0, &[R1.into()]), group(1.0, &[])],
        "groups[1]: a group needs at least one factor",
    );
    assert_eq!(Space::product(vec![]), Err(SpaceError::EmptyGroup(0)));
}

#[test]
fn a_real_vector_has_a_dimension() {
    assert_eq!(
        Space::product(vec![R1.into(), Factor::RealVector(0).into()]),
        Err(SpaceError::NoDimensions)
    );
}

#[test]
fn weights_are_finite_and_not_negative() {
    for weight in [-1.0, -5e-324, f64::INFINITY, f64::NEG_INFINITY, f64::NAN] {
        let of_a_term = vec![
            group(1.0, &[R1.into()]),
            group(1.0, &[R1.into(), term(R1, weight)]),
        ];
        assert_refused(
            of_a_term,
            &format!("groups[1].terms[1]: weight {weight:?}: weights are finite and at least 0"),
        );
        let of_a_group = vec![group(weight, &[R1.into()])];
        assert_refused(
            of_a_group,
            &format!("groups[0]: weight {weight:?}: weights are finite and at least 0"),
        );
    }
}

#[test]
fn at_least_one_factor_counts() {
    let refused = Err(SpaceError::NoWeight);
    assert_eq!(Space::product(vec![term(R1, 0.0)]), refused);
    assert_eq!(Space::new(vec![group(0.0, &[R1.into()])]), refused);
    // One group has the weight 0, and the terms of the other have it.
    let crossed = vec![group(0.0, &[R1.into()]), group(1.0, &[term(R1, 0.0)])];
    assert_eq!(Space::new(crossed), refused);
    // The smallest weights are valid, although their product underflows.
    assert!(Space::new(vec![group(1e-300, &[term(R1, 1e-300)])]).is_ok());
}

#[test]
fn periods_are_in_range() {
    for period in [0.0, -1.0, 1e-151, 1e151, f64::INFINITY, f64::NAN] {
        let refused = Space::product(vec![Factor::SO2 { period }.into()]).unwrap_err();
        assert!(matches!(refused, SpaceError::Period(_)), "{refused}");
    }
    for period in [1e-150, 1.0, 1e150] {
        assert!(Space::product(vec![Factor::SO2 { period }.into()]).is_ok());
    }
}

#[test]
fn coordinates_are_counted_without_overflow() {
    let of = |dimensions: &[usize]| {
        Space::product(
            dimensions
                .iter()
                .map(|n| Factor::RealVector(*n).into())
                .collect(),
        )
    };
    assert!(of(&[Space::MAX_COORDINATES]).is_ok());
    for dimensions in [
        &[257][..],
        &[128, 129],
        &[usize::MAX, 1],
        &[usize::MAX, usize::MAX],
    ] {
        assert_eq!(of(dimensions), Err(SpaceError::TooManyCoordinates));
    }
    assert_eq!(
        Space::product(vec![Factor::SO3.into(); 65]),
        Err(SpaceError::TooManyCoordinates)
    );
}

#[test]
fn dimension_is_that_of_the_manifold() {
    for (text, coordinates, dimension) in [
        ("R3", 3, 3),
        ("SO2^3", 3, 3),
        ("SO3", 4, 3),
        ("R2*SO2", 3, 3),
        ("R3*SO3:0.15", 7, 6),
        ("sum(R3, SO3)", 7, 6),
        ("(R3*SO3:0.15)^8", 56, 48),
    ] {
        let space: Space = text.parse().unwrap();
        assert_eq!(
            (space.coordinates(), space.dimension()),
            (coordinates, dimension),
            "{text}"
        );
    }
}

#[test]
fn spaces_are_equal_after_expansion() {
    let equal = |a: &str, b: &str| a.parse::<Space>().unwrap() == b.parse::<Space>().unwrap();
    for (a, b) in [
        ("R3*R3", "R3^2"),
        ("(R3*SO3)^2", "R3*SO3*R3*SO3"),
        ("R3", "sum(R3)"),
        ("R3:1", "R3"),
        ("R3*SO3:0.15", "sum(R3*SO3:0.15)"),
        ("sum(R1^7)", "moveit-joints-7"),
        ("SO2", "SO2[6.283185307179586]"),
        ("S1*RP3", "SO2*SO3"),
        ("(R1:2*SO2):3", "R1:6*SO2:3"),
        ("R1:-0*R2", "R1:0*R2"),
    ] {
        assert!(equal(a, b), "{a} and {b}");
    }
    for (a, b) in [
        ("R3*R3", "R6"),
        ("R3*SO3", "SO3*R3"),
        ("R3*SO3", "sum(R3, SO3)"),
        ("R3*SO3", "R3*SO3:0.15"),
        ("R3:2", "sum(R3:2)"),
        ("SO2", "SO2[6.28]"),
        ("SO2", "R1"),
        ("sum((SO2^2), R3)", "sum(SO2^2, R3)"),
    ] {
        assert!(!equal(a, b), "{a} and {b}");
    }
}
