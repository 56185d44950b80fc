//! Progress bars of long commands.

use std::{borrow::Cow, io::IsTerminal};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// A bar on standard error that counts up to `rows`, or without an end if the number is not known. It is hidden if
/// standard error is no terminal, or if results are printed (`prints`) on a terminal.
pub(super) fn bar(
    rows: Option<u64>,
    what: impl Into<Cow<'static, str>>,
    prints: bool,
) -> ProgressBar {
    let target = match prints && std::io::stdout().is_terminal() {
        true => ProgressDrawTarget::hidden(),
        false => ProgressDrawTarget::stderr(),
    };
    let template = match rows {
        Some(_) => "{msg} {wide_bar} {human_pos}/{human_len}, {eta} left",
        None => "{msg} {spinner} {human_pos}",
    };
    let bar = ProgressBar::with_draw_target(rows, target).with_message(what);
    // The templates are constants; the default stands in for one that does not parse.
    let style =
        ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
    bar.with_style(style)
        .with_finish(indicatif::ProgressFinish::AndClear)
}

/// A line on standard error that shows what is under way; it is hidden if standard error is no terminal.
pub(super) fn line() -> ProgressBar {
    let line = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
    let style = ProgressStyle::with_template("{spinner} {msg}");
    // The template is a constant; the default stands in for one that does not parse.
    line.with_style(style.unwrap_or_else(|_| ProgressStyle::default_spinner()))
        .with_finish(indicatif::ProgressFinish::AndClear)
}
