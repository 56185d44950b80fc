//! Progress of long work, on a terminal.

use std::{borrow::Cow, io::IsTerminal};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// A bar on standard error that counts rows up to `rows`, or on and on if the number is not known. Nothing is drawn
/// where standard error is no terminal, or where results are printed (`prints`) on the same one.
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
    // The templates are fixed; should one not parse, the default does.
    let style =
        ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
    bar.with_style(style)
        .with_finish(indicatif::ProgressFinish::AndClear)
}
