//! Finds the known name closest to a misspelt one.

use strsim::levenshtein;

/// The name in `known` closest to `written`, the first one on a tie. The last parts are compared too, for a key that
/// was written outside its section.
pub(super) fn nearest<'a>(written: &str, known: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    known.min_by_key(|candidate| {
        let whole = levenshtein(written, candidate);
        whole.min(1 + levenshtein(last(written), last(candidate)))
    })
}

fn last(key: &str) -> &str {
    key.rsplit('.').next().unwrap_or(key)
}
