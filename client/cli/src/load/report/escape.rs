//! Text in HTML.

use std::fmt;

/// A text as the content of an element or of a quoted attribute of HTML.
pub(super) struct Escaped<'a>(pub(super) &'a str);

impl fmt::Display for Escaped<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for letter in self.0.chars() {
            match letter {
                '&' => f.write_str("&amp;")?,
                '<' => f.write_str("&lt;")?,
                '>' => f.write_str("&gt;")?,
                '"' => f.write_str("&quot;")?,
                '\'' => f.write_str("&#39;")?,
                // A page may not hold the other control characters, not even escaped.
                letter if letter.is_control() && !matches!(letter, '\n' | '\t') => {
                    f.write_str("\u{fffd}")?;
                }
                letter => write!(f, "{letter}")?,
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_text_ends_an_element_or_an_attribute() {
        for (text, expected) in [
            ("R3*SO3:0.15", "R3*SO3:0.15"),
            (
                "<script>a && b</script>",
                "&lt;script&gt;a &amp;&amp; b&lt;/script&gt;",
            ),
            ("\"' onload='x", "&quot;&#39; onload=&#39;x"),
            ("&lt;", "&amp;lt;"),
            ("a\u{0}\u{1b}[31m\nb", "a\u{fffd}\u{fffd}[31m\nb"),
            ("µs – ≤", "µs – ≤"),
        ] {
            assert_eq!(Escaped(text).to_string(), expected);
        }
    }
}
