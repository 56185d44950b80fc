//! The trace context of a call, after W3C Trace Context, level 1.

/// The id of the trace and that of the caller's span in a `traceparent`, `00-TRACE-PARENT-FLAGS`; None if it is malformed,
/// or not for tracing.
pub(crate) fn trace_ids(traceparent: &str) -> Option<(&str, &str)> {
    let mut parts = traceparent.split('-');
    let version = parts.next().filter(|it| is_hex(it, 2) && *it != "ff")?;
    let trace = parts.next().filter(|it| is_hex(it, 32))?;
    let parent = parts.next().filter(|it| is_hex(it, 16))?;
    parts.next().filter(|it| is_hex(it, 2))?;
    // Later versions may append parts, and the first one has none.
    let is_whole = version != "00" || parts.next().is_none();
    let is_zero = |id: &str| id.bytes().all(|digit| digit == b'0');
    (is_whole && !is_zero(trace) && !is_zero(parent)).then_some((trace, parent))
}

fn is_hex(text: &str, digits: usize) -> bool {
    let is_digit = |byte: u8| byte.is_ascii_digit() || (b'a'..=b'f').contains(&byte);
    text.len() == digits && text.bytes().all(is_digit)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The examples of the recommendation, section 3.2, and what it calls invalid.
    #[test]
    fn the_ids_are_those_of_the_recommendation() {
        const TRACE: &str = "4bf92f3577b34da6a3ce929d0e0e4736";
        let parent = "00f067aa0ba902b7";
        for valid in [
            format!("00-{TRACE}-{parent}-01"),
            format!("00-{TRACE}-{parent}-00"),
            format!("cc-{TRACE}-{parent}-01-what-the-future-will-be-like"),
        ] {
            assert_eq!(trace_ids(&valid), Some((TRACE, parent)), "{valid}");
        }
        let zeros = "0".repeat(32);
        for invalid in [
            String::new(),
            format!("ff-{TRACE}-{parent}-01"),
            format!("00-{zeros}-{parent}-01"),
            format!("00-{TRACE}-0000000000000000-01"),
            format!("00-{TRACE}-{parent}-01-more"),
            format!("00-{}-{parent}-01", TRACE.to_uppercase()),
            format!("00-{TRACE}-{parent}"),
        ] {
            assert_eq!(trace_ids(&invalid), None, "{invalid}");
        }
    }
}
