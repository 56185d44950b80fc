//! Log lines: filtered, as text or JSON, on standard error.

use std::io::{self, IsTerminal};

use serde::Deserialize;
use thiserror::Error;
use tracing::{Level, Metadata};
use tracing_subscriber::{
    EnvFilter, Layer,
    filter::{ParseError, filter_fn},
    fmt,
    layer::SubscriberExt,
    util::{SubscriberInitExt, TryInitError},
};

/// The form of a log line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, clap::ValueEnum)]
#[serde(try_from = "String")]
pub enum LogFormat {
    /// For people.
    Text,
    /// One JSON object a line.
    Json,
}

impl TryFrom<String> for LogFormat {
    type Error = String;

    fn try_from(name: String) -> Result<Self, String> {
        match name.as_str() {
            "text" => Ok(Self::Text),
            "json" => Ok(Self::Json),
            _ => Err(format!("\"{name}\" is neither \"text\" nor \"json\"")),
        }
    }
}

/// The error of the start of logging.
#[derive(Debug, Error)]
pub enum LoggingError {
    /// The filter does not parse.
    #[error(
        "log.filter: `{filter}` is not a filter ({source}); examples: `info`, `debug`, `warn,wayfold_server=debug`"
    )]
    Filter {
        /// The filter.
        filter: String,
        /// The problem.
        source: ParseError,
    },
    /// This process has a logger already.
    #[error("this process has a logger already: {0}")]
    Started(#[from] TryInitError),
}

/// These libraries log only if the filter names them: their lines repeat the server's, or do not help.
const SILENCED_LIBRARIES: [&str; 3] = ["zenoh", "fjall", "lsm_tree"];

/// Starts logging to standard error: the lines of this process that pass `filter`.
pub(crate) fn start(filter: &str, format: LogFormat) -> Result<(), LoggingError> {
    let mut lines = EnvFilter::try_new(filter);
    for library in SILENCED_LIBRARIES {
        if !names(filter, library) {
            let directive = format!("{library}=off").parse();
            lines = lines.and_then(|lines| Ok(lines.add_directive(directive?)));
        }
    }
    let filter = lines.map_err(|source| LoggingError::Filter {
        filter: filter.to_owned(),
        source,
    })?;
    let lines = fmt::layer()
        .with_writer(io::stderr)
        .with_ansi(io::stderr().is_terminal());
    let lines = match format {
        LogFormat::Text => lines.boxed(),
        LogFormat::Json => lines.json().boxed(),
    };
    let registry = tracing_subscriber::registry().with(lines).with(filter);
    registry.with(filter_fn(has_no_secrets)).try_init()?;
    Ok(())
}

/// True if a directive of the filter is for the library or a part of it, and not for a module of the server of this name.
fn names(filter: &str, library: &str) -> bool {
    let mut directives = filter.split(',');
    directives.any(|it| it.trim().starts_with(library))
}

/// At the levels debug and trace, Zenoh writes its configuration and whole messages, and the client of NATS its address:
/// passwords and tokens of callers are parts of them. The part of Zenoh that opens links writes their locators at any level,
/// which may carry a private key; the server's own lines tell the same without it.
fn has_no_secrets(lines: &Metadata<'_>) -> bool {
    const OPENS_LINKS: &str = "zenoh::net::runtime::orchestrator";
    let library = lines.target();
    let is_of = |name| library.starts_with(name);
    !is_of(OPENS_LINKS)
        && (*lines.level() < Level::DEBUG || !(is_of("zenoh") || is_of("async_nats")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_module_of_the_server_is_not_the_library_of_this_name() {
        for (filter, expected) in [
            ("info", false),
            ("info,wayfold_server::zenoh=debug", false),
            ("info,zenoh=warn", true),
            ("info, zenoh=warn", true),
            ("zenoh::net=debug", true),
            ("zenoh_transport=debug,info", true),
        ] {
            assert_eq!(names(filter, "zenoh"), expected, "{filter}");
        }
    }
}
