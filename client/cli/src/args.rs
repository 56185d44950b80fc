//! The arguments that every verb has, and the list of verbs.

use std::{ffi::OsString, time::Duration};

use clap::{CommandFactory, Parser, Subcommand, error::ErrorKind};

use super::{output::Format, parse, verb};

const EXAMPLES: &str = "\
Examples:
  wayfold create arm --space 'R3*SO3:0.15'      poses: x, y, z and a quaternion x, y, z, w
  wayfold insert arm poses.csv                  a row a state; prints how many were inserted
  wayfold knn arm -k 10 --state 0.1,0.2,0.3,0,0,0,1
  wayfold query arm queries.npy --radius 0.5 --output json
  wayfold scan arm roadmap.csv                  ids and states; insert reads it with --ids id
  wayfold snapshot arm arm.snapshot             a backup, of which restore makes an index again

Exit status: 0, 1 for an error (told on standard error), 2 for wrong usage.
`wayfold COMMAND --help` tells more of a command.";

/// Shared, exact nearest-neighbour indices for motion planners: the command line.
///
/// An index holds points in one configuration space. Programs in many processes insert states into it and ask for
/// neighbours; this command does the same from a shell. Results are printed on standard output, as a table or as a
/// line of JSON each.
#[derive(Debug, Parser)]
#[command(name = "wayfold", version, after_help = EXAMPLES, max_term_width = 100)]
pub(super) struct Args {
    /// Where the server listens; `verify` takes it more than once
    #[arg(
        long,
        global = true,
        help_heading = "Options of every command",
        env = "WAYFOLD_SERVER",
        value_name = "URL",
        default_value = "http://127.0.0.1:50051"
    )]
    pub(super) server: Vec<String>,

    /// How results are printed: a table for people, or a line of JSON each for programs
    ///
    /// In JSON, ids from 2^53 up are strings, because not every reader keeps such numbers whole; an infinite distance
    /// is null.
    #[arg(
        long,
        global = true,
        help_heading = "Options of every command",
        value_enum,
        value_name = "FORMAT",
        default_value = "text"
    )]
    pub(super) output: Format,

    /// How long to wait for a server that is still starting, and for each call: 500ms, 5s, 1m
    #[arg(long, global = true, help_heading = "Options of every command", value_name = "TIME", default_value = "5s", value_parser = parse::duration)]
    pub(super) timeout: Duration,

    #[command(subcommand)]
    pub(super) command: Command,
}

#[derive(Debug, Subcommand)]
pub(super) enum Command {
    Create(verb::CreateArgs),
    /// Lists the indices
    ///
    /// Those that the server cannot read are listed too, with the reason; the exit status is 1 then.
    List,
    Info(verb::InfoArgs),
    Delete(verb::DeleteArgs),
    Insert(verb::InsertArgs),
    Knn(verb::KnnArgs),
    Query(verb::QueryArgs),
    Get(verb::GetArgs),
    Remove(verb::RemoveArgs),
    Scan(verb::ScanArgs),
    Snapshot(verb::SnapshotArgs),
    Restore(verb::RestoreArgs),
    Verify(verb::VerifyArgs),
    Watch(verb::WatchArgs),
}

impl Args {
    /// The arguments of the process, if they make sense together.
    pub(super) fn read() -> Result<Args, clap::Error> {
        let args = Args::try_parse()?;
        let refused = |problem| Err(Args::command().error(ErrorKind::ArgumentConflict, problem));
        if args.server.len() > 1 && !matches!(args.command, Command::Verify(_)) {
            return refused("--server is given more than once, which only verify takes");
        }
        // Of an option that stands on both sides of a verb, clap passes over what stands before it.
        if std::env::args_os().filter(is_server).count() > args.server.len() {
            return refused("give every --server before the verb, or every one after it");
        }
        Ok(args)
    }
}

fn is_server(argument: &OsString) -> bool {
    let bytes = argument.as_encoded_bytes();
    bytes == b"--server" || bytes.starts_with(b"--server=")
}
