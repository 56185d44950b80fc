//! The command line flags and the `--help` page.

use std::{collections::BTreeMap, env, path::PathBuf};

use clap::{Parser, Subcommand};

use crate::{
    config::{Config, ConfigError, ON},
    observe::LogFormat,
};

// Lines stay within 80 columns: clap wraps longer ones, which breaks the tables.
const ABOUT: &str = "\
Wayfold: shared nearest-neighbour indices for sampling-based motion planners.

The server holds named indices, one for each configuration space. Planners, in
many processes and on many machines, insert states into them over gRPC or
Zenoh and ask for the neighbours of states. Answers are exact: they equal brute
force.";

const AFTER: &str = "\
Settings:
  A file or the environment sets everything else. --print-config prints all
  settings with their defaults and explanations. Flags override the environment,
  the environment overrides the file:
    in the file          [limits]
                         max_k = 500
    in the environment   WAYFOLD_LIMITS__MAX_K=500

Examples:
  wayfold-server                             this machine only, port 50051
  wayfold-server --grpc 127.0.0.1:0          any free port; the first line names it
  wayfold-server --zenoh off                 gRPC and HTTP only
  wayfold-server --data /var/lib/wayfold     keeps the indices there
  wayfold-server --data memory               loses the indices when it stops
  wayfold-server --config my.toml            TLS and identities, for every network
  wayfold-server --print-config > my.toml    a file to edit, for --config my.toml
  wayfold-server --log wayfold_server=debug  a log line for every call
  wayfold-server repair --dry-run            reports the damage of a store
  wayfold-server reseed arm                  begins arm anew in a cluster, from this server's points

  Then, in another terminal:
  wayfold create arm --space 'R3*SO3:0.15'
  wayfold insert arm states.csv
  wayfold knn arm --state 0,0,0,0,0,0,1 -k 10

Output:
  Once the server answers calls, it prints a line `listening on http://ADDRESS`
  to standard output, a line `listening on tcp/ADDRESS` for Zenoh, a line `metrics
  at http://ADDRESS/metrics`, and the next commands to type. Log lines go to standard error.

Data:
  Indices are kept in ./wayfold-data, and every acknowledged mutation is on disk;
  see data.durability in --print-config. While the server starts, calls fail with
  UNAVAILABLE until it has read its indices.

Stopping:
  On SIGINT (Ctrl-C) or SIGTERM the server refuses new calls, finishes the accepted
  ones, and exits. A second signal ends it at once.

Exit status:
  0          the server stopped and finished every accepted call
  1          the server could not start, for example because another server uses
             the data directory, or it cut calls after shutdown.grace_ms; with
             --print-config, standard output cannot be written
  2          the command line or the settings are wrong
  130, 143   ended by a second SIGINT or SIGTERM

Next:
  wayfold --help describes the client, proto/wayfold/v1/ the calls. The server
  describes its calls by reflection:
  grpcurl -plaintext 127.0.0.1:50051 describe wayfold.v1.PointService";

const AFTER_REPAIR: &str = "\
Stop the server first. The command reads the store in the data directory from end
to end. If a part of it cannot be read, it writes a new store with every index that
can be read whole, and keeps the damaged one beside it as store.damaged-N. The
other indices keep only their names: delete them and restore their snapshots.

With --dry-run too, the store is opened as by a server that starts: an interrupted
repair is finished, small files that all indices share are put back, and after an
unclean stop the journal files are rewritten.

The new store needs about as many free bytes as the old one takes; --dry-run names
the number, the damage and the indices that a repair loses.

Exit status:
  0          the store is whole, or was rebuilt
  1          --dry-run found damage, or an index is beyond repair: its records are lost
             or damaged in files that can be read; or standard output cannot be written
  2          the command line or the settings are wrong
  3          the store cannot be repaired, for example because a server uses it, the
             disk is full, or its list of files is damaged; the old store is kept";

const AFTER_RESEED: &str = "\
Stop all servers of the cluster first, this one last, so that no other one writes
meanwhile; NATS has to run. The index gets a new uid and a new journal, which begin
with the points, the writer sessions and the revision of the data directory. The name
moves to it, and the old one is deleted at all servers: what only others have is
lost, so take snapshots of theirs before. The command prints the number of revisions
of the journal that it left out. Clients that watch the index begin again, and
operation ids of calls to the old one are forgotten.

The data directory needs room for the points twice until the server starts again.

Exit status:
  0          the index goes on under its new uid
  1          it does not, for example because a server uses the data directory, or
             NATS does not answer; or standard output cannot be written
  2          the command line or the settings are wrong";

/// The parsed flags.
#[derive(Debug, Parser)]
#[command(
    name = "wayfold-server",
    version,
    disable_help_subcommand = true,
    about = ABOUT,
    after_help = AFTER,
    max_term_width = 100
)]
pub(super) struct Flags {
    /// Read settings from FILE, in TOML
    #[arg(
        long,
        value_name = "FILE",
        env = "WAYFOLD_CONFIG",
        hide_env_values = true,
        global = true
    )]
    config: Option<PathBuf>,
    /// Address to listen on [default: 127.0.0.1:50051]
    #[arg(long, value_name = "ADDR")]
    grpc: Option<String>,
    /// Zenoh locator to listen on, or off [default: tcp/127.0.0.1:7448]
    #[arg(long, value_name = "LOCATOR")]
    zenoh: Option<String>,
    /// Address of page, API and /metrics, or off [default: 127.0.0.1:8080]
    #[arg(long, value_name = "ADDR")]
    http: Option<String>,
    /// Directory of the indices, or memory [default: ./wayfold-data]
    #[arg(long, value_name = "DIR", global = true)]
    data: Option<String>,
    /// Log level: error, warn, info, debug, trace [default: info]
    #[arg(long, value_name = "FILTER", global = true)]
    log: Option<String>,
    /// Form of the log lines: text, json [default: text]
    #[arg(
        long,
        value_name = "FORMAT",
        hide_possible_values = true,
        global = true
    )]
    log_format: Option<LogFormat>,
    /// Listen beyond this machine without TLS or identities
    #[arg(long)]
    insecure: bool,
    /// Print all settings with defaults and explanations, and exit
    #[arg(long)]
    pub(super) print_config: bool,
    #[command(subcommand)]
    pub(super) command: Option<Command>,
}

/// A job of the program other than serving.
#[derive(Debug, Subcommand)]
pub(super) enum Command {
    /// Rebuild a damaged store from everything that can be read of it
    #[command(after_help = AFTER_REPAIR)]
    Repair {
        /// Report the damage and the cost of a repair, and rebuild nothing
        #[arg(long)]
        dry_run: bool,
    },
    /// Start a new generation of an index of a cluster from the points of this server
    #[command(after_help = AFTER_RESEED)]
    Reseed {
        /// Name of the index
        index: String,
        /// Its uid, if the data directory has several indices of this name
        #[arg(long)]
        uid: Option<String>,
    },
}

impl Flags {
    /// The settings from all layers.
    pub(super) fn settings(&self) -> Result<Config, ConfigError> {
        let mut environment = BTreeMap::new();
        // All our variables have Unicode names: skip the others.
        let named =
            env::vars_os().filter_map(|(name, value)| Some((name.into_string().ok()?, value)));
        for (name, value) in named {
            if let Ok(value) = value.into_string() {
                environment.insert(name, value);
            } else if name.starts_with("WAYFOLD_") && name.contains("__") {
                return Err(ConfigError::Value {
                    origin: "environment".to_owned(),
                    key: name,
                    problem: "its value is not UTF-8; set it to UTF-8 text, and rename a path that is not UTF-8"
                        .to_owned(),
                });
            }
        }
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
            ("http.listen", self.http.clone()),
            ("data.dir", self.data.clone()),
            ("log.filter", self.log.clone()),
            ("log.format", format),
            ("access.insecure", self.insecure.then(|| ON.to_owned())),
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
    fn repair_takes_the_data_directory_before_and_after_its_name() {
        for line in [
            ["wayfold-server", "--data", "d", "repair", "--dry-run"],
            ["wayfold-server", "repair", "--dry-run", "--data", "d"],
        ] {
            let flags = Flags::try_parse_from(line).unwrap();
            assert_eq!(flags.data.as_deref(), Some("d"));
            let is_dry = matches!(flags.command, Some(Command::Repair { dry_run: true }));
            assert!(is_dry, "{line:?}");
        }
    }

    #[test]
    fn the_defaults_that_help_names_are_the_defaults() {
        let help = Flags::command().render_help().to_string();
        let config = Config::default();
        for default in [
            &config.grpc.listen,
            &config.http.listen,
            &config.zenoh.listen,
            &config.log.filter,
            &config.data.dir,
        ] {
            assert!(help.contains(&format!("[default: {default}]")), "{default}");
        }
        assert_eq!(config.log.format, LogFormat::Text);
    }
}
