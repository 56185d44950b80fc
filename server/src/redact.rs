//! Problems of texts that users wrote, without the texts: these may hold a secret.

/// The place and the kind of an error in `text`.
pub(crate) fn toml(error: &toml::de::Error, text: &str) -> String {
    // The parser's own messages are fixed texts.
    let kind = without_value(error.message()).unwrap_or_else(|| error.message().to_owned());
    let Some(before) = error.span().and_then(|span| text.get(..span.start)) else {
        return kind;
    };
    let line = before.matches('\n').count() + 1;
    let last = before.rsplit('\n').next().unwrap_or(before);
    let column = last.chars().count() + 1;
    format!("line {line}, column {column}: {kind}")
}

/// A message of serde without the wrong value; None if it has another form, which may show a value.
pub(crate) fn without_value(message: &str) -> Option<String> {
    const WITH_VALUE: [&str; 3] = ["invalid type", "invalid value", "unknown variant"];
    const WITH_NAME: [&str; 4] = [
        "unknown field",
        "missing field",
        "duplicate field",
        "invalid length",
    ];
    if WITH_NAME.iter().any(|kind| message.starts_with(kind)) {
        return Some(message.to_owned());
    }
    let kind = WITH_VALUE.iter().find(|kind| message.starts_with(**kind))?;
    Some(match message.rsplit_once(", expected ") {
        Some((_, expected)) => format!("{kind}, expected {expected}"),
        None => (*kind).to_owned(),
    })
}
