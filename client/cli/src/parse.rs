//! Parsers of the values of options.

use std::time::Duration;

/// A time as `500ms`, `5s`, `1.5m` or `1h`.
pub(super) fn duration(text: &str) -> Result<Duration, String> {
    const EXPECTED: &str = "expected a number above 0 and its unit, as in 500ms, 5s, 1m or 1h";
    let digits = text
        .find(|c: char| !c.is_ascii_digit() && c != '.')
        .unwrap_or(text.len());
    let (number, unit) = text.split_at(digits);
    let seconds = match unit {
        "ms" => 1e-3,
        "s" => 1.0,
        "m" => 60.0,
        "h" => 3600.0,
        _ => return Err(EXPECTED.to_owned()),
    };
    let number: f64 = number.parse().map_err(|_| EXPECTED.to_owned())?;
    match Duration::try_from_secs_f64(number * seconds) {
        Ok(duration) if !duration.is_zero() && duration <= MAX_DURATION => Ok(duration),
        Ok(duration) if duration > MAX_DURATION => Err("the longest is 10000h".to_owned()),
        _ => Err(EXPECTED.to_owned()),
    }
}

/// The header `grpc-timeout` holds more than this.
const MAX_DURATION: Duration = Duration::from_secs(10_000 * 3600);

/// A distance: a number, at least 0, or `inf`.
pub(super) fn distance(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(distance) if distance >= 0.0 => Ok(distance),
        _ => Err("expected a number, at least 0, or inf".to_owned()),
    }
}

/// A finite number, at least 0.
pub(super) fn finite(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(number) if number >= 0.0 && number.is_finite() => Ok(number),
        _ => Err("expected a finite number, at least 0".to_owned()),
    }
}

/// An id: a whole number below 2^63.
pub(super) fn id(text: &str) -> Result<u64, String> {
    match text.parse::<u64>() {
        Ok(id) if id < 1 << 63 => Ok(id),
        _ => Err("expected an id, a whole number from 0 to 9223372036854775807".to_owned()),
    }
}

/// A tag, or some of its bits: `tag & mask == value`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct MaskedTag {
    pub(super) value: u64,
    pub(super) mask: u64,
}

/// A tag: a whole number below 2^64, decimal or `0x` and hexadecimal.
pub(super) fn tag(text: &str) -> Result<u64, String> {
    let number = match text.strip_prefix("0x") {
        // `from_str_radix` would take a sign.
        Some(digits) if digits.starts_with('+') => None,
        Some(digits) => u64::from_str_radix(digits, 16).ok(),
        None => text.parse().ok(),
    };
    number.ok_or_else(|| "expected a tag, a whole number below 2^64, as 3 or 0x3".to_owned())
}

/// A tag as `VALUE`, or some of its bits as `VALUE/MASK`.
pub(super) fn masked_tag(text: &str) -> Result<MaskedTag, String> {
    let masked = match text.split_once('/') {
        None => MaskedTag {
            value: tag(text)?,
            mask: u64::MAX,
        },
        Some((value, mask)) => MaskedTag {
            value: tag(value)?,
            mask: tag(mask)?,
        },
    };
    match masked.value & !masked.mask {
        0 => Ok(masked),
        outside => Err(format!("the value has bits outside the mask: {outside:#x}")),
    }
}

/// A revision: its number, and the uid of the index if it is given.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct RevisionArg {
    pub(super) number: u64,
    pub(super) uid: Option<String>,
}

/// A revision as `NUMBER` or `NUMBER@UID`.
pub(super) fn revision(text: &str) -> Result<RevisionArg, String> {
    let (number, uid) = match text.split_once('@') {
        Some((number, uid)) => (number, Some(uid)),
        None => (text, None),
    };
    match number.parse() {
        Ok(number) if uid != Some("") => Ok(RevisionArg {
            number,
            uid: uid.map(str::to_owned),
        }),
        _ => Err("expected the number of a revision, and @ and a uid after it if known".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_have_a_unit() {
        assert_eq!(duration("500ms"), Ok(Duration::from_millis(500)));
        assert_eq!(duration("5s"), Ok(Duration::from_secs(5)));
        assert_eq!(duration("1.5m"), Ok(Duration::from_secs(90)));
        assert_eq!(duration("2h"), Ok(Duration::from_secs(7200)));
        for wrong in [
            "", "5", "s", "5 s", "-1s", "0s", "0.0ms", "1e3s", "5sec", "1.2.3s", "infs", "99999h",
            "5µs",
        ] {
            assert!(duration(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn distances_are_not_negative() {
        assert_eq!(distance("0.5"), Ok(0.5));
        assert_eq!(distance("inf"), Ok(f64::INFINITY));
        assert_eq!(finite("0"), Ok(0.0));
        for wrong in ["-0.1", "nan", "", "x", "1,2"] {
            assert!(
                distance(wrong).is_err() && finite(wrong).is_err(),
                "{wrong}"
            );
        }
        assert!(finite("inf").is_err());
    }

    #[test]
    fn ids_are_below_2_to_the_63() {
        assert_eq!(id("9223372036854775807"), Ok(u64::MAX / 2));
        for wrong in ["9223372036854775808", "-1", "1.0", "", "a"] {
            assert!(id(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn tags_are_decimal_or_hexadecimal_and_may_have_a_mask() {
        let masked = |value, mask| Ok(MaskedTag { value, mask });
        assert_eq!(masked_tag("3"), masked(3, u64::MAX));
        assert_eq!(masked_tag("0xffFFffffFFFFffff"), masked(u64::MAX, u64::MAX));
        assert_eq!(
            masked_tag("18446744073709551615"),
            masked(u64::MAX, u64::MAX)
        );
        assert_eq!(masked_tag("0x3/0xff"), masked(3, 255));
        assert_eq!(masked_tag("0/4"), masked(0, 4));
        for wrong in [
            "",
            "-1",
            "0x",
            "0x+1",
            "ff",
            "1.0",
            "18446744073709551616",
            "1/",
            "/1",
            "1/1/1",
            "2/1",
        ] {
            assert!(masked_tag(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn revisions_may_have_a_uid() {
        let arg = |number, uid: Option<&str>| {
            Ok(RevisionArg {
                number,
                uid: uid.map(str::to_owned),
            })
        };
        assert_eq!(revision("42"), arg(42, None));
        assert_eq!(revision("0@a-b"), arg(0, Some("a-b")));
        for wrong in ["", "-1", "x", "@a", "1@", "a@1"] {
            assert!(revision(wrong).is_err(), "{wrong}");
        }
    }
}
