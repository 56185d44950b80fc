//! What is typed as the value of a flag.

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
        Ok(duration) if !duration.is_zero() && duration <= LONGEST => Ok(duration),
        Ok(duration) if duration > LONGEST => Err("the longest is 10000h".to_owned()),
        _ => Err(EXPECTED.to_owned()),
    }
}

/// What the `grpc-timeout` header can say, and more than anybody waits.
const LONGEST: Duration = Duration::from_secs(10_000 * 3600);

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
}
