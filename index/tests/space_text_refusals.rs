//! The text form: the errors and their places.

use wayfold_index::{Space, SpaceError};

/// The texts, the column of the error, a part of the expected syntax, and the found text.
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
        // The parser stops at the 257th factor, so the rest is never read.
        &format!("{}?", "R1*".repeat(100_000)),
    ] {
        let refused = Err(SpaceError::TooManyCoordinates);
        assert_eq!(text.parse::<Space>(), refused, "{text}");
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
