//! The known word that a wrong one was probably meant to be.

/// `; did you mean NAME?`, or nothing if no known name is near.
pub(super) fn hint(given: &str, known: &[&str]) -> String {
    match nearest(given, known) {
        Some(name) => format!("; did you mean {name}?"),
        None => String::new(),
    }
}

/// The known name that differs from the given one in the fewest letters, if that is less than half of them.
fn nearest<'a>(given: &str, known: &[&'a str]) -> Option<&'a str> {
    let distances = known
        .iter()
        .map(|name| (strsim::damerau_levenshtein(given, name), *name));
    let (distance, name) = distances.min_by_key(|(distance, _)| *distance)?;
    let letters = given.chars().count().max(name.chars().count());
    (2 * distance < letters).then_some(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slip_is_found_and_another_word_is_not() {
        let known = ["rate", "radius", "duration", "workers"];
        for (given, meant) in [
            ("rat", Some("rate")),
            ("raet", Some("rate")),
            ("raduis", Some("radius")),
            ("durations", Some("duration")),
            ("worker", Some("workers")),
            ("colour", None),
            ("", None),
        ] {
            assert_eq!(nearest(given, &known), meant, "{given}");
        }
        assert_eq!(hint("rat", &known), "; did you mean rate?");
        assert_eq!(hint("zzz", &known), "");
    }
}
