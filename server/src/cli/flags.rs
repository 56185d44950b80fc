//! The flags, and the page that `--help` prints.

use std::{collections::BTreeMap, env, path::PathBuf};

use clap::Parser;

use crate::{
    config::{Config, ConfigError},
    observe::LogFormat,
};

// Kept to 80 columns: clap breaks longer lines where it must, and so breaks the tables.
const ABOUT: &str = "\
Wayfold: shared nearest-neighbour indices for sampling-based motion planners.

The server holds named indices, one for each configuration space. Planners, in
many processes and on many machines, insert states into them over gRPC or
Zenoh and ask for the neighbours of states. Answers are exact: they equal brute
force.";

const AFTER: &str = "\
Settings:
  Everything else is set in a file or in the environment. --print-config prints
  all settings with their defaults and what they mean. Flags win over the
  environment, the environment wins over the file:
    in the file          [limits]
                         k = 500
    in the environment   WAYFOLD_LIMITS__K=500

Examples:
  wayfold-server                             this machine only, port 50051
  wayfold-server --grpc 127.0.0.1:0          any free port; the first line says it
  wayfold-server --zenoh off                 gRPC only
  wayfold-server --data /var/lib/wayfold     indices are kept there
  wayfold-server --data memory               and here they are gone with the server
  wayfold-server --grpc 0.0.0.0:50051        every network; no authentication yet
  wayfold-server --print-config > my.toml    a file to edit, for --config my.toml
  wayfold-server --log wayfold_server=debug  a log line for every call

  Then, in another terminal:
  wayfold create arm --space 'R3*SO3:0.15'
  wayfold insert arm states.csv
  wayfold knn arm --state 0,0,0,0,0,0,1 -k 10

Output:
  Standard output gets a line `listening on http://ADDRESS` once calls are
  answered, one `listening on tcp/ADDRESS` for Zenoh, and then what to type next. Log lines go to standard error.

Data:
  Indices are kept in ./wayfold-data, and every mutation that was acknowledged is
  on disk; see data.durability in --print-config. A server that starts answers
  UNAVAILABLE until it has read its indices.

Stopping:
  On SIGINT (Ctrl-C) or SIGTERM the server takes no new calls, finishes those it
  accepted, and exits. A second signal ends it at once.

Exit status:
  0          stopped, with every accepted call finished
  1          could not start, for example because another server uses the data
             directory, or had to cut calls after shutdown.grace_ms
  2          the command line or the settings are wrong
  130, 143   ended by a second SIGINT or SIGTERM

Next:
  wayfold --help describes the client, proto/wayfold/v1/ the calls. The server
  describes them too:
  grpcurl -plaintext 127.0.0.1:50051 describe wayfold.v1.PointService";

/// The flags as they were given.
#[derive(Debug, Parser)]
#[command(
    name = "wayfold-server",
    version,
    about = ABOUT,
    after_help = AFTER,
    max_term_width = 100
)]
pub(super) struct Flags {
    /// Settings to take from FILE, in TOML
    #[arg(
        long,
        value_name = "FILE",
        env = "WAYFOLD_CONFIG",
        hide_env_values = true
    )]
    config: Option<PathBuf>,
    /// Address to listen on [default: 127.0.0.1:50051]
    #[arg(long, value_name = "ADDR")]
    grpc: Option<String>,
    /// Zenoh locator to listen on, or off [default: tcp/127.0.0.1:7448]
    #[arg(long, value_name = "LOCATOR")]
    zenoh: Option<String>,
    /// Directory for the indices, or memory for none [default: ./wayfold-data]
    #[arg(long, value_name = "DIR")]
    data: Option<String>,
    /// Log lines to write: error, warn, info, debug, trace [default: info]
    #[arg(long, value_name = "FILTER")]
    log: Option<String>,
    /// How to write them: text, json [default: text]
    #[arg(long, value_name = "FORMAT", hide_possible_values = true)]
    log_format: Option<LogFormat>,
    /// Print all settings with their defaults, explained, and exit
    #[arg(long)]
    pub(super) print_config: bool,
}

impl Flags {
    /// The settings of all layers.
    pub(super) fn settings(&self) -> Result<Config, ConfigError> {
        // A variable that is not Unicode can be none of ours.
        let environment: BTreeMap<String, String> = env::vars_os()
            .filter_map(|(name, value)| Some((name.into_string().ok()?, value.into_string().ok()?)))
            .collect();
        Config::load(self.config.as_deref(), &environment, &self.layer())
    }

    fn layer(&self) -> Vec<(&'static str, String)> {
        let format = self.log_format.map(|format| match format {
            LogFormat::Text => "text".to_owned(),
            LogFormat::Json => "json".to_owned(),
        });
        [
            ("grpc.listen", self.grpc.clone()),
            ("zenoh.listen", self.zenoh.clone()),
            ("data.dir", self.data.clone()),
            ("log.filter", self.log.clone()),
            ("log.format", format),
        ]
        .into_iter()
        .filter_map(|(key, value)| Some((key, value?)))
        .collect()
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_definition_is_sound() {
        Flags::command().debug_assert();
    }

    #[test]
    fn the_defaults_that_help_names_are_the_defaults() {
        let help = Flags::command().render_help().to_string();
        let config = Config::default();
        for default in [
            &config.grpc.listen,
            &config.zenoh.listen,
            &config.log.filter,
            &config.data.dir,
        ] {
            assert!(help.contains(&format!("[default: {default}]")), "{default}");
        }
        assert_eq!(config.log.format, LogFormat::Text);
    }
}
