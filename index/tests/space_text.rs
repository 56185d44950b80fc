//! The text form: its meaning, the errors and their places, and that the printed form is read as the same space.

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

/// Texts, what they print as, and what they mean.
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
        // Numbers print with the fewest digits that say the same.
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

/// Texts, the column of what is wrong, a part of what is expected, and what is found.
#[test]
fn refusals_say_where_and_what() {
    let table: &[(&str, usize, &str, &str)] = &[
        ("", 1, "a factor", "the end"),
        ("  ", 3, "a factor", "the end"),
        ("SO4", 1, "a factor", "\"SO4\""),
        ("so2", 1, "a factor", "\"so2\""),
        ("3", 1, "a factor", "\"3\""),
        ("R", 1, "a dimension after R", "\"R\""),
        ("R^3", 1, "a dimension after R", "\"R\""),
        ("R3*R0", 4, "at least 1", "\"R0\""),
        ("R3x", 1, "a factor", "\"R3x\""),
        ("R3*", 4, "a factor", "the end"),
        ("R3**R1", 4, "a factor", "\"*\""),
        ("R3 SO3", 4, "* or the end", "\"SO3\""),
        ("R3, SO3", 3, "* or the end", "\",\""),
        ("R3×SO3", 3, "* or the end", "\"×\""),
        ("×", 1, "a factor", "\"×\""),
        ("R3)", 3, "* or the end", "\")\""),
        ("(R3", 4, "* or )", "the end"),
        ("(R3, R1)", 4, "* or )", "\",\""),
        ("()", 2, "a factor", "\")\""),
        ("R3:", 4, "a weight, finite and at least 0", "the end"),
        ("R3:x", 4, "a weight", "\"x\""),
        ("R3:-1", 4, "a weight", "\"-1\""),
        ("R3:1e999", 4, "a weight", "\"1e999\""),
        ("R3:inf", 4, "a weight", "\"inf\""),
        ("R3:nan", 4, "a weight", "\"nan\""),
        ("R3:1e-", 4, "a weight", "\"1e-\""),
        ("R3:1.2.3", 4, "a weight", "\"1.2.3\""),
        ("R3:1,5", 5, "* or the end", "\",\""),
        ("R3:2:3", 5, "one weight, and before the count", "\":\""),
        ("R3^2:3", 5, "one weight, and before the count", "\":\""),
        (
            "sum(SO2^2:3)",
            10,
            "one weight, and before the count",
            "\":\"",
        ),
        ("R3^0", 4, "a count from 1 to 256", "\"0\""),
        ("R3^-2", 4, "a count", "\"-2\""),
        ("R3^1.5", 4, "a count", "\"1.5\""),
        ("R3^257", 4, "a count", "\"257\""),
        ("R1^4000000000", 4, "a count", "\"4000000000\""),
        (
            "R1^99999999999999999999999",
            4,
            "a count",
            "\"99999999999999999999999\"",
        ),
        ("R3^2^2", 5, "* or the end", "\"^\""),
        ("SO2[", 5, "a period from 1e-150 to 1e150", "the end"),
        ("SO2[]", 5, "a period", "\"]\""),
        ("SO2[0]", 5, "a period", "\"0\""),
        ("SO2[-1]", 5, "a period", "\"-1\""),
        ("SO2[1e151]", 5, "a period", "\"1e151\""),
        ("SO2[1", 6, "] after the period", "the end"),
        ("SO3[1]", 4, "* or the end", "\"[\""),
        ("R3[1]", 3, "* or the end", "\"[\""),
        ("sum", 4, "( after sum", "the end"),
        ("sum R3", 5, "( after sum", "\"R3\""),
        ("sum()", 5, "a factor", "\")\""),
        ("sum(R3", 7, "*, a comma or )", "the end"),
        ("sum(R3,)", 8, "a factor", "\")\""),
        ("sum(R3 R1)", 8, "*, a comma or )", "\"R1\""),
        ("sum(R3))", 8, "the end: a sum stands outermost", "\")\""),
        ("sum(R3):2", 8, "the end: a sum stands outermost", "\":\""),
        ("sum(R3)^2", 8, "the end: a sum stands outermost", "\"^\""),
        ("sum(R3)*R1", 8, "the end: a sum stands outermost", "\"*\""),
        ("R1*sum(R3, R2)", 4, "nothing deeper is accepted", "\"sum\""),
        (
            "sum(R1, sum(R3, R2))",
            9,
            "nothing deeper is accepted",
            "\"sum\"",
        ),
        ("(sum(R3, R2))", 2, "nothing deeper is accepted", "\"sum\""),
    ];
    for &(whole, at, what, instead) in table {
        match whole.parse::<Space>() {
            Err(SpaceError::Syntax {
                text,
                column,
                expected,
                found,
            }) => {
                assert_eq!((text.as_str(), column), (whole, at));
                assert!(expected.contains(what), "{whole}: expected {expected}");
                assert_eq!(found, instead, "{whole}");
            }
            other => panic!("{whole}: {other:?}"),
        }
    }
}

#[test]
fn a_refusal_is_one_readable_line() {
    let message = |text: &str| text.parse::<Space>().unwrap_err().to_string();
    assert_eq!(
        message("R3*SO3:x"),
        "space \"R3*SO3:x\", column 8: expected a weight, finite and at least 0, found \"x\""
    );
    let long = message(&format!("R3\n* {}", "A".repeat(100_000)));
    assert!(long.len() < 400 && !long.contains('\n'), "{long}");
}

#[test]
fn texts_cannot_ask_for_much() {
    for text in [
        "R257",
        "R4000000000",
        "R99999999999999999999999999",
        "R2^129",
        "((((R1^256)^256)^256)^256)^256",
        "sum((R1^256)^256)",
        "sum(R128, R128, R1)",
        "SO3^65",
        "R18446744073709551615*R18446744073709551615",
        // Given up at the 257th factor, whatever follows.
        &format!("{}?", "R1*".repeat(100_000)),
    ] {
        assert_eq!(
            text.parse::<Space>(),
            Err(SpaceError::TooManyCoordinates),
            "{text}"
        );
    }
    assert_eq!("R256".parse::<Space>().unwrap().coordinates(), 256);
    assert_eq!("SO3^64".parse::<Space>().unwrap().dimension(), 192);

    let nested = |depth| format!("{}R1{}", "(".repeat(depth), ")".repeat(depth));
    assert_eq!(nested(32).parse::<Space>(), "R1".parse());
    for depth in [33, 1_000_000] {
        let error = nested(depth).parse::<Space>().unwrap_err();
        assert!(error.to_string().contains("at most 32 deep"), "{error}");
    }
}

#[test]
fn weights_that_multiply_out_of_range_are_refused() {
    assert_eq!(
        "(R1:1e-200):1e-200".parse::<Space>(),
        Err(SpaceError::NoWeight)
    );
    let overflow = "(R1:1e200):1e200".parse::<Space>();
    assert!(matches!(
        overflow,
        Err(SpaceError::Weight {
            weight: f64::INFINITY,
            ..
        })
    ));
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
    fn what_is_printed_is_read_as_the_same_space(space in spaces()) {
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
