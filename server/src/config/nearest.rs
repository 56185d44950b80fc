//! Finds the known name closest to a misspelt one.

/// The name in `known` closest to `written`, the first one on a tie. The last parts are compared too, for a key that
/// was written outside its section.
pub(super) fn nearest<'a>(written: &str, known: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    known.min_by_key(|candidate| {
        let whole = distance(written, candidate);
        whole.min(1 + distance(last(written), last(candidate)))
    })
}

fn last(key: &str) -> &str {
    key.rsplit('.').next().unwrap_or(key)
}

/// The Levenshtein distance between `a` and `b`.
fn distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, from) in a.chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, to) in b.iter().enumerate() {
            let exchanged = diagonal + usize::from(from != *to);
            diagonal = row[j + 1];
            row[j + 1] = exchanged.min(row[j] + 1).min(row[j + 1] + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_known_from_textbooks() {
        for (a, b, expected) in [
            ("kitten", "sitting", 3),
            ("saturday", "sunday", 3),
            ("", "abc", 3),
            ("same", "same", 0),
        ] {
            assert_eq!(distance(a, b), expected);
            assert_eq!(distance(b, a), expected);
        }
    }

    #[test]
    fn a_misspelt_name_finds_its_setting() {
        let known = [
            "grpc.listen",
            "grpc.max_connections",
            "limits.max_k",
            "log.filter",
        ];
        for (written, meant) in [
            ("grpc.listne", "grpc.listen"),
            ("max_connections", "grpc.max_connections"),
            ("server.listen", "grpc.listen"),
            ("limits.max_K", "limits.max_k"),
        ] {
            assert_eq!(
                nearest(written, known.into_iter()),
                Some(meant),
                "{written}"
            );
        }
    }
}
