//! The text form: its meaning, and that the printed form is read as the same space.

#![expect(clippy::unwrap_used, reason = "a test stops where its helper fails")]

use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use wayfold_index::{Factor, Group, Space, SpaceError, Term};

const R1: Factor = Factor::RealVector(1);
const R2: Factor = Factor::RealVector(2);
const R3: Factor = Factor::RealVector(3);
const SO2: Factor = Factor::so2();
const SO3: Factor = Factor::SO3;

/// A group by its weight and terms.
type GroupOf<'a> = (f64, &'a [(Factor, f64)]);

fn space(groups: &[GroupOf<'_>]) -> Space {
    let term = |&(factor, weight): &(Factor, f64)| Term { factor, weight };
    let groups = groups.iter().map(|(weight, terms)| Group {
        weight: *weight,
        terms: terms.iter().map(term).collect(),
    });
    Space::new(groups.collect()).unwrap()
}

/// The texts, their printed forms, and their groups.
#[test]
fn reads_what_the_grammar_says() {
    let body: &[(Factor, f64)] = &[(R3, 1.0), (SO3, 0.15)];
    let two = [body, body].concat();
    let table: &[(&str, &str, &[GroupOf<'_>])] = &[
        ("R3", "R3", &[(1.0, &[(R3, 1.0)])]),
        (" R3\t* SO3 : 0.15\n", "R3*SO3:0.15", &[(1.0, body)]),
        ("R3*RP3:.15", "R3*SO3:0.15", &[(1.0, body)]),
        ("R3*SO3:15e-2", "R3*SO3:0.15", &[(1.0, body)]),
        ("S1", "SO2", &[(1.0, &[(SO2, 1.0)])]),
        ("SO2[6.283185307179586]", "SO2", &[(1.0, &[(SO2, 1.0)])]),
        (
            "SO2 [ 1 ] : 2",
            "SO2[1]:2",
            &[(1.0, &[(Factor::SO2 { period: 1.0 }, 2.0)])],
        ),
        // Products are flat; a weight of parentheses multiplies the weights within.
        ("(R3)", "R3", &[(1.0, &[(R3, 1.0)])]),
        ("((R3*(SO3:0.15)))", "R3*SO3:0.15", &[(1.0, body)]),
        (
            "(R3*SO3:0.5):2*R1",
            "R3:2*SO3*R1",
            &[(1.0, &[(R3, 2.0), (SO3, 1.0), (R1, 1.0)])],
        ),
        ("(R3:2):3", "R3:6", &[(1.0, &[(R3, 6.0)])]),
        ("R1:0*R2", "R1:0*R2", &[(1.0, &[(R1, 0.0), (R2, 1.0)])]),
        // A weight binds before a count.
        ("R3:2^2", "R3:2^2", &[(1.0, &[(R3, 2.0), (R3, 2.0)])]),
        (
            "SO2^3",
            "SO2^3",
            &[(1.0, &[(SO2, 1.0), (SO2, 1.0), (SO2, 1.0)])],
        ),
        ("R3^1", "R3", &[(1.0, &[(R3, 1.0)])]),
        ("(R3*RP3:0.15)^2", "(R3*SO3:0.15)^2", &[(1.0, &two)]),
        ("R3*SO3:0.15*R3*SO3:0.15", "(R3*SO3:0.15)^2", &[(1.0, &two)]),
        (
            "(R1^2*SO2)^2",
            "(R1^2*SO2)^2",
            &[(
                1.0,
                &[
                    (R1, 1.0),
                    (R1, 1.0),
                    (SO2, 1.0),
                    (R1, 1.0),
                    (R1, 1.0),
                    (SO2, 1.0),
                ],
            )],
        ),
        // Arguments of a sum are groups, their weights multiply distances.
        ("sum(R3)", "R3", &[(1.0, &[(R3, 1.0)])]),
        ("sum(R3:2)", "sum(R3:2)", &[(2.0, &[(R3, 1.0)])]),
        (
            "sum ( R3 , SO3 )",
            "sum(R3, SO3)",
            &[(1.0, &[(R3, 1.0)]), (1.0, &[(SO3, 1.0)])],
        ),
        (
            "sum(R2, SO2:0.5)",
            "sum(R2, SO2:0.5)",
            &[(1.0, &[(R2, 1.0)]), (0.5, &[(SO2, 1.0)])],
        ),
        (
            "sum((R2:0.5), SO2)",
            "sum((R2:0.5), SO2)",
            &[(1.0, &[(R2, 0.5)]), (1.0, &[(SO2, 1.0)])],
        ),
        (
            "sum((R2:0.5):3, SO2)",
            "sum((R2:0.5):3, SO2)",
            &[(3.0, &[(R2, 0.5)]), (1.0, &[(SO2, 1.0)])],
        ),
        ("sum(R3*SO3:0.15)", "R3*SO3:0.15", &[(1.0, body)]),
        (
            "sum(R3*SO3:0.15, R1)",
            "sum(R3*SO3:0.15, R1)",
            &[(1.0, body), (1.0, &[(R1, 1.0)])],
        ),
        (
            "sum((R3*SO3:0.15):2)",
            "sum((R3*SO3:0.15):2)",
            &[(2.0, body)],
        ),
        (
            "sum((R3*SO3:0.15):2^2)",
            "sum((R3*SO3:0.15):2^2)",
            &[(2.0, body), (2.0, body)],
        ),
        (
            "sum((R3*SO3:0.15)^2, R1)",
            "sum((R3*SO3:0.15)^2, R1)",
            &[(1.0, body), (1.0, body), (1.0, &[(R1, 1.0)])],
        ),
        (
            "sum(R1^3)",
            "sum(R1^3)",
            &[
                (1.0, &[(R1, 1.0)]),
                (1.0, &[(R1, 1.0)]),
                (1.0, &[(R1, 1.0)]),
            ],
        ),
        (
            "sum(R1, R1, R1)",
            "sum(R1^3)",
            &[
                (1.0, &[(R1, 1.0)]),
                (1.0, &[(R1, 1.0)]),
                (1.0, &[(R1, 1.0)]),
            ],
        ),
        (
            "sum((SO2^2), R3)",
            "sum((SO2^2), R3)",
            &[(1.0, &[(SO2, 1.0), (SO2, 1.0)]), (1.0, &[(R3, 1.0)])],
        ),
        (
            "sum(SO2^2, R3)",
            "sum(SO2^2, R3)",
            &[
                (1.0, &[(SO2, 1.0)]),
                (1.0, &[(SO2, 1.0)]),
                (1.0, &[(R3, 1.0)]),
            ],
        ),
        (
            "sum(SO2^2*R1, R3)",
            "sum(SO2^2*R1, R3)",
            &[
                (1.0, &[(SO2, 1.0), (SO2, 1.0), (R1, 1.0)]),
                (1.0, &[(R3, 1.0)]),
            ],
        ),
        // Numbers print with the fewest digits that parse to the same value.
        ("R1:1e-7", "R1:1e-7", &[(1.0, &[(R1, 1e-7)])]),
        ("R1:0.10000000000000001", "R1:0.1", &[(1.0, &[(R1, 0.1)])]),
        (
            "R1:1e22*R1:1.7976931348623157E+308",
            "R1:1e22*R1:1.7976931348623157e308",
            &[(1.0, &[(R1, 1e22), (R1, f64::MAX)])],
        ),
        (
            "SO2[1e-150]*SO2[1e150]",
            "SO2[1e-150]*SO2[1e150]",
            &[(
                1.0,
                &[
                    (Factor::SO2 { period: 1e-150 }, 1.0),
                    (Factor::SO2 { period: 1e150 }, 1.0),
                ],
            )],
        ),
        ("R1:-0*R1", "R1:0*R1", &[(1.0, &[(R1, 0.0), (R1, 1.0)])]),
    ];
    for &(text, printed, groups) in table {
        let read: Space = text
            .parse()
            .unwrap_or_else(|error| panic!("{text}: {error}"));
        assert_eq!(read, space(groups), "{text}");
        assert_eq!(read.to_string(), printed, "{text}");
        assert_eq!(printed.parse(), Ok(read), "{text}");
    }
}

#[test]
fn presets_are_names_of_whole_spaces() {
    for (name, text) in [
        ("mpnn-se3", "R3*RP3:0.15"),
        ("ompl-se2", "sum(R2, SO2:0.5)"),
        ("ompl-se3", "sum(R3, SO3)"),
        ("ompl-torus", "SO2^2"),
        ("moveit-joints-7", "sum(R1^7)"),
        ("moveit-joints-256", "sum(R1^256)"),
        (" mpnn-se3 ", "R3*SO3:0.15"),
    ] {
        assert_eq!(name.parse::<Space>(), text.parse::<Space>(), "{name}");
    }
    assert_eq!(Space::se2(), "R2*SO2".parse().unwrap());
    assert_eq!(Space::se3(), "R3*SO3:0.15".parse().unwrap());
    for text in [
        "mpnn-se3*R1",
        "sum(mpnn-se3)",
        "moveit-joints-",
        "moveit-joints-x",
        "moveit-joints-+7",
        "ompl-se4",
    ] {
        let error = text.parse::<Space>().unwrap_err();
        assert!(
            matches!(error, SpaceError::Syntax { .. }),
            "{text}: {error}"
        );
    }
    assert_eq!("moveit-joints-0".parse::<Space>(), Err(SpaceError::Empty));
    assert_eq!(
        "moveit-joints-257".parse::<Space>(),
        Err(SpaceError::TooManyCoordinates)
    );
}

fn factors() -> impl Strategy<Value = Factor> {
    prop_oneof![
        (1..4_usize).prop_map(Factor::RealVector),
        Just(SO2),
        prop_oneof![Just(1.0), 1e-150..1e150, 0.1..10.0].prop_map(|period| Factor::SO2 { period }),
        Just(SO3),
    ]
}

fn weights() -> impl Strategy<Value = f64> {
    prop_oneof![
        4 => Just(1.0),
        1 => Just(0.0),
        2 => prop::sample::select(&[0.15, 15.0, 1e-7, 5e-324, 1e15, 1e16, 123_456.789, f64::MAX][..]),
        1 => 0.0..10.0,
    ]
}

/// Terms of a group: often few different ones, so that blocks of them repeat.
fn terms() -> impl Strategy<Value = Vec<Term>> {
    let term = (factors(), weights()).prop_map(|(factor, weight)| Term { factor, weight });
    (
        prop::collection::vec(term, 1..4),
        prop::collection::vec(0..4_usize, 1..9),
        1..4_usize,
    )
        .prop_map(|(choices, order, times)| {
            let block: Vec<Term> = order.iter().map(|i| choices[i % choices.len()]).collect();
            block.repeat(times)
        })
}

fn spaces() -> impl Strategy<Value = Space> {
    let group = (weights(), terms()).prop_map(|(weight, terms)| Group { weight, terms });
    prop_oneof![
        terms().prop_map(Space::product),
        (
            prop::collection::vec(group, 1..4),
            prop::collection::vec(0..3_usize, 1..6)
        )
            .prop_map(|(choices, order)| {
                Space::new(
                    order
                        .iter()
                        .map(|i| choices[i % choices.len()].clone())
                        .collect(),
                )
            }),
    ]
    .prop_filter_map("too many coordinates, or no weight", Result::ok)
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 5000,
        rng_seed: RngSeed::Fixed(1),
        failure_persistence: None,
        ..Default::default()
    })]

    #[test]
    fn printed_text_is_read_as_the_same_space(space in spaces()) {
        let text = space.to_string();
        let read: Space = text.parse().unwrap_or_else(|error| panic!("{error}"));
        prop_assert_eq!(&read, &space, "{}", text);
        prop_assert_eq!(read.to_string(), text);
    }

    #[test]
    fn no_text_is_too_much(text in "[R0-9SOPum(),:^*\\[\\]. e+-]{0,40}|(R3|SO2|SO3|RP3|S1|sum|[(),:^*\\[\\]1-9. ]){0,30}|\\PC{0,20}") {
        if let Ok(space) = text.parse::<Space>() {
            prop_assert_eq!(space.to_string().parse(), Ok(space));
        }
    }
}
