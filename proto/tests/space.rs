//! Spaces as messages: the round trip, what a message may leave out, and which messages are refused.

#![expect(clippy::unwrap_used, reason = "a test stops where its helper fails")]

use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use prost::Message;
use wayfold_index::{Factor, Group, Space, SpaceError, Term};
use wayfold_proto::space::{SpaceMessageProblem, from_message, to_message};
use wayfold_proto::v1::{self, Composition, space::Kind};

fn real_vector(dimensions: u32) -> v1::Space {
    let kind = Some(Kind::RealVector(v1::RealVector { dimensions }));
    v1::Space { kind }
}

fn so2(period: Option<f64>) -> v1::Space {
    let kind = Some(Kind::So2(v1::So2 { period }));
    v1::Space { kind }
}

fn so3() -> v1::Space {
    let kind = Some(Kind::So3(v1::So3 {}));
    v1::Space { kind }
}

fn product(composition: i32, terms: &[(v1::Space, Option<f64>)]) -> v1::Space {
    let terms = terms.iter().map(|(space, weight)| v1::Term {
        space: Some(space.clone()),
        weight: *weight,
    });
    let kind = Some(Kind::Product(v1::Product {
        composition,
        terms: terms.collect(),
    }));
    v1::Space { kind }
}

fn l2(terms: &[(v1::Space, Option<f64>)]) -> v1::Space {
    product(Composition::L2.into(), terms)
}

fn sum(terms: &[(v1::Space, Option<f64>)]) -> v1::Space {
    product(Composition::Sum.into(), terms)
}

fn space(text: &str) -> Space {
    text.parse().unwrap()
}

#[test]
fn messages_mean_what_the_contract_says() {
    let body = l2(&[(real_vector(3), None), (so3(), Some(0.15))]);
    for (message, text) in [
        (real_vector(3), "R3"),
        (so2(None), "SO2"),
        (so2(Some(1.0)), "SO2[1]"),
        (so3(), "SO3"),
        (body.clone(), "R3*SO3:0.15"),
        (l2(&[(so2(None), Some(2.0))]), "SO2:2"),
        (
            sum(&[(real_vector(3), None), (so3(), Some(0.5))]),
            "sum(R3, SO3:0.5)",
        ),
        (
            sum(&[(body.clone(), Some(2.0)), (so2(None), None)]),
            "sum((R3*SO3:0.15):2, SO2)",
        ),
        (sum(&[(so3(), Some(2.0))]), "sum(SO3:2)"),
        // L2 within L2 expands, its weight multiplying the weights within.
        (
            l2(&[
                (
                    l2(&[(body.clone(), Some(2.0)), (so2(None), None)]),
                    Some(10.0),
                ),
                (so3(), None),
            ]),
            "R3:20*SO3:3*SO2:10*SO3",
        ),
        (
            sum(&[(l2(&[(l2(&[(so3(), Some(3.0))]), Some(2.0))]), Some(5.0))]),
            "sum((SO3:6):5)",
        ),
        (
            l2(&[(real_vector(1), Some(0.0)), (so3(), None)]),
            "R1:0*SO3",
        ),
    ] {
        assert_eq!(from_message(&message), Ok(space(text)), "{text}");
    }
}

#[test]
fn spaces_are_sent_expanded() {
    for (text, message) in [
        ("R3", real_vector(3)),
        ("SO2", so2(None)),
        ("SO2[1]", so2(Some(1.0))),
        ("SO3:2", l2(&[(so3(), Some(2.0))])),
        (
            "R1^2",
            l2(&[(real_vector(1), None), (real_vector(1), None)]),
        ),
        (
            "(R3*SO3:0.15):2",
            l2(&[(real_vector(3), Some(2.0)), (so3(), Some(0.3))]),
        ),
        (
            "sum(R2, SO2:0.5)",
            sum(&[(real_vector(2), None), (so2(None), Some(0.5))]),
        ),
        ("sum(R2:2)", sum(&[(real_vector(2), Some(2.0))])),
        (
            "sum((SO2^2), R3)",
            sum(&[
                (l2(&[(so2(None), None), (so2(None), None)]), None),
                (real_vector(3), None),
            ]),
        ),
        (
            "sum((SO3:2), R3)",
            sum(&[(l2(&[(so3(), Some(2.0))]), None), (real_vector(3), None)]),
        ),
    ] {
        assert_eq!(to_message(&space(text)), message, "{text}");
    }
}

#[test]
fn refusals_name_the_field() {
    let nothing = v1::Space { kind: None };
    let no_space = {
        let mut message = l2(&[(so3(), None), (so3(), None), (so3(), None)]);
        if let Some(Kind::Product(product)) = &mut message.kind {
            product.terms[2].space = None;
        }
        message
    };
    let in_third = |message: v1::Space| sum(&[(so3(), None), (so3(), None), (message, None)]);
    let unset = "not set; set one of real_vector, so2, so3 and product";
    let deeper =
        "a SUM product within a product; a SUM stands outermost, nothing deeper is accepted";
    for (message, text) in [
        (nothing.clone(), format!("kind: {unset}")),
        (in_third(nothing.clone()), format!("product.terms[2].space.kind: {unset}")),
        (
            in_third(l2(&[(nothing, None)])),
            format!("product.terms[2].space.product.terms[0].space.kind: {unset}"),
        ),
        (no_space.clone(), "product.terms[2].space: not set".into()),
        (
            l2(&[(no_space, None)]),
            "product.terms[0].space.product.terms[2].space: not set".into(),
        ),
        (
            product(0, &[(so3(), None)]),
            "product.composition: unspecified or unknown (0); \
             set COMPOSITION_L2 (1) or COMPOSITION_SUM (2)"
                .into(),
        ),
        (
            in_third(product(7, &[(so3(), None)])),
            "product.terms[2].space.product.composition: unspecified or unknown (7); \
             set COMPOSITION_L2 (1) or COMPOSITION_SUM (2)"
                .into(),
        ),
        (l2(&[]), "product.terms: empty; a product has at least one term".into()),
        (
            in_third(l2(&[])),
            "product.terms[2].space.product.terms: empty; a product has at least one term".into(),
        ),
        (
            in_third(sum(&[(so3(), None)])),
            format!("product.terms[2].space.product.composition: {deeper}"),
        ),
        (
            l2(&[(sum(&[(so3(), None)]), None)]),
            format!("product.terms[0].space.product.composition: {deeper}"),
        ),
        (
            l2(&[(so3(), None), (so3(), Some(-1.0))]),
            "product.terms[1].weight: -1.0; weights are finite and at least 0".into(),
        ),
        (
            in_third(l2(&[(so3(), Some(f64::NAN))])),
            "product.terms[2].space.product.terms[0].weight: NaN; weights are finite and at least 0".into(),
        ),
        (
            real_vector(0),
            "real_vector.dimensions: R0 has no coordinates: \
             the dimension of a real vector is at least 1"
                .into(),
        ),
        (
            in_third(so2(Some(0.0))),
            "product.terms[2].space.so2.period: period 0.0: \
             the period of an SO2 is a number from 1e-150 to 1e150"
                .into(),
        ),
        (
            in_third(real_vector(u32::MAX)),
            "product.terms[2].space.real_vector.dimensions: \
             a space has at most 256 coordinates, and this one has more"
                .into(),
        ),
        (
            l2(&[(real_vector(200), None), (real_vector(57), None)]),
            "product: a space has at most 256 coordinates, and this one has more".into(),
        ),
        (
            sum(&[(so3(), Some(0.0))]),
            "product: all weights are 0: at least one factor needs a weight above 0, and its group too"
                .into(),
        ),
    ] {
        assert_eq!(from_message(&message).unwrap_err().to_string(), text);
    }
}

/// The messages are refused before they are expanded, even if nested products multiply the terms.
#[test]
fn messages_of_too_many_terms_are_refused() {
    let many = l2(&vec![(so3(), None); 257]);
    let nested = l2(&vec![(l2(&vec![(so3(), None); 200]), None); 200]);
    for (message, path) in [
        (many, "product.terms"),
        (nested, "product.terms[1].space.product.terms"),
    ] {
        let error = from_message(&message).unwrap_err();
        let problem = SpaceMessageProblem::Space(SpaceError::TooManyCoordinates);
        assert_eq!((error.path.as_str(), error.problem), (path, problem));
    }
}

#[test]
fn weights_that_multiply_out_of_range_are_refused() {
    let huge = l2(&[(l2(&[(so3(), Some(1e200))]), Some(1e200))]);
    let error = from_message(&huge).unwrap_err();
    assert_eq!(error.path, "product");
    let SpaceMessageProblem::Space(SpaceError::Weight { weight, .. }) = error.problem else {
        panic!("{error}");
    };
    assert_eq!(weight, f64::INFINITY);
}

fn spaces() -> impl Strategy<Value = Space> {
    let factor = || {
        prop_oneof![
            (1..5_usize).prop_map(Factor::RealVector),
            Just(Factor::so2()),
            (1e-3..1e3).prop_map(|period| Factor::SO2 { period }),
            Just(Factor::SO3),
        ]
    };
    let weight = || prop_oneof![3 => Just(1.0), 1 => Just(0.0), 2 => 1e-9..1e9];
    let term = (factor(), weight()).prop_map(|(factor, weight)| Term { factor, weight });
    let group = (weight(), prop::collection::vec(term, 1..5))
        .prop_map(|(weight, terms)| Group { weight, terms });
    prop::collection::vec(group, 1..5)
        .prop_filter_map("no weight", |groups| Space::new(groups).ok())
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 2000,
        rng_seed: RngSeed::Fixed(2),
        failure_persistence: None,
        ..Default::default()
    })]

    #[test]
    fn a_space_survives_the_wire(space in spaces()) {
        let bytes = to_message(&space).encode_to_vec();
        let message = v1::Space::decode(bytes.as_slice()).unwrap();
        prop_assert_eq!(from_message(&message), Ok(space));
    }
}
