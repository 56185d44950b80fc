//! Reads `grpc-timeout`, the header for the time that a client waits.

use std::time::{Duration, Instant};

use http::HeaderMap;
use thiserror::Error;

/// The name of the header.
pub(crate) const HEADER: &str = "grpc-timeout";

/// The specification's most digits, which also keep the arithmetic below from overflowing.
const MAX_DIGITS: usize = 8;

/// A `grpc-timeout` header that does not follow the specification.
#[derive(Debug, Error, PartialEq, Eq)]
#[error(
    "`{0}` is not a timeout: 1 to 8 digits and a unit of H, M, S, m, u or n, such as `250m` for 250 ms"
)]
pub(crate) struct MalformedTimeout(String);

/// The caller's deadline, if any, for a request whose headers arrived at `arrived`.
pub(crate) fn read(
    headers: &HeaderMap,
    arrived: Instant,
) -> Result<Option<Instant>, MalformedTimeout> {
    let Some(value) = headers.get(HEADER) else {
        return Ok(None);
    };
    let timeout =
        value.to_str().ok().and_then(parse).ok_or_else(|| {
            MalformedTimeout(String::from_utf8_lossy(value.as_bytes()).into_owned())
        })?;
    // A time beyond the clock's range is no deadline.
    Ok(arrived.checked_add(timeout))
}

fn parse(text: &str) -> Option<Duration> {
    let (digits, unit) = text.split_at_checked(text.len().checked_sub(1)?)?;
    if digits.is_empty() || digits.len() > MAX_DIGITS || !digits.bytes().all(|b| b.is_ascii_digit())
    {
        return None;
    }
    let amount: u64 = digits.parse().ok()?;
    match unit {
        "H" => Some(Duration::from_secs(amount * 3600)),
        "M" => Some(Duration::from_secs(amount * 60)),
        "S" => Some(Duration::from_secs(amount)),
        "m" => Some(Duration::from_millis(amount)),
        "u" => Some(Duration::from_micros(amount)),
        "n" => Some(Duration::from_nanos(amount)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read_text(text: &str) -> Result<Option<Duration>, MalformedTimeout> {
        let mut headers = HeaderMap::new();
        headers.insert(HEADER, text.parse().unwrap());
        let arrived = Instant::now();
        read(&headers, arrived).map(|deadline| deadline.map(|at| at - arrived))
    }

    #[test]
    fn every_unit_of_the_specification() {
        for (text, expected) in [
            ("3H", Duration::from_secs(3 * 3600)),
            ("2M", Duration::from_secs(120)),
            ("42S", Duration::from_secs(42)),
            ("250m", Duration::from_millis(250)),
            ("7u", Duration::from_micros(7)),
            ("0n", Duration::ZERO),
            ("99999999H", Duration::from_secs(99_999_999 * 3600)),
        ] {
            assert_eq!(read_text(text), Ok(Some(expected)), "{text}");
        }
    }

    #[test]
    fn no_header_is_no_deadline() {
        assert_eq!(read(&HeaderMap::new(), Instant::now()), Ok(None));
    }

    #[test]
    fn anything_else_is_refused() {
        for text in [
            "",
            "S",
            "5",
            "5s",
            "-5S",
            "+5S",
            "1.5S",
            "123456789S",
            "5 S",
            "5é",
        ] {
            assert!(read_text(text).is_err(), "{text}");
        }
    }
}
