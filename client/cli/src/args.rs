//! The options that every verb has, and the list of verbs.

use std::{env, ffi::OsString, time::Duration};

use clap::{
    CommandFactory, FromArgMatches, Parser, Subcommand, builder::Resettable, error::ErrorKind,
};

use super::{
    connection::ConnectionArgs, load::LoadArgs, output::Format, parse, status::Status, verb,
};

const EXAMPLES: &str = "\
Examples:
  wayfold create arm --space 'R3*SO3:0.15'      poses: x, y, z and a quaternion x, y, z, w
  wayfold insert arm poses.csv                  one state a row; prints how many were inserted
  wayfold knn arm -k 10 --state 0.1,0.2,0.3,0,0,0,1
  wayfold query arm queries.npy --radius 0.5 --output json
  wayfold scan arm roadmap.csv                  ids and states; `insert --ids id` reads the file
  wayfold snapshot arm arm.snapshot             a backup; `restore` creates an index from it
  wayfold load arm --rate 500 --report arm.html calls it, and measures the answers
";

fn after_help() -> String {
    let statuses = Status::help();
    format!(
        "{EXAMPLES}\n{statuses}\n\
         With --output json an error is one line on standard error,\n\
         {{\"error\":{{\"code\":...,\"reason\":...,\"message\":...}}}}: code is the name of a gRPC status, reason is\n\
         for programs to match on; ids, fields and metadata follow where the server sent them.\n\n\
         `wayfold COMMAND --help` describes a command."
    )
}

/// Shared, exact nearest-neighbour indices for motion planners: the command line.
///
/// An index holds points in one configuration space. Programs in many processes insert states into it and search it for
/// neighbours; this command does the same from a shell. Results go to standard output, as a table or as lines of JSON.
#[derive(Debug, Parser)]
#[command(name = "wayfold", version, after_help = after_help(), max_term_width = 100)]
pub(super) struct Args {
    /// The server's address, or those of servers that share their indices, with commas between them; `verify` takes
    /// the option several times
    #[arg(
        long,
        global = true,
        help_heading = "Options of every command",
        env = "WAYFOLD_SERVER",
        value_name = "URL",
        default_value = "http://127.0.0.1:50051"
    )]
    pub(super) server: Vec<String>,

    /// The format of results and errors: tables for people, or lines of JSON for programs
    ///
    /// In JSON, ids and tags from 2^53 up are strings, because not every reader keeps such numbers exact; an infinite
    /// distance is null.
    #[arg(
        long,
        global = true,
        help_heading = "Options of every command",
        value_enum,
        value_name = "FORMAT",
        default_value = "text"
    )]
    pub(super) output: Format,

    /// The longest wait for each call and for a server that is starting: 500ms, 5s, 1m
    #[arg(long, global = true, help_heading = "Options of every command", value_name = "TIME", default_value = "5s", value_parser = parse::duration)]
    pub(super) timeout: Duration,

    #[command(flatten)]
    pub(super) connection: ConnectionArgs,

    #[command(subcommand)]
    pub(super) command: Command,
}

#[derive(Debug, Subcommand)]
pub(super) enum Command {
    Create(verb::CreateArgs),
    /// Lists the indices
    ///
    /// Damaged indices, which cannot be read or cannot be written, are listed with the cause; the exit status is then 1.
    List,
    Info(verb::InfoArgs),
    Delete(verb::DeleteArgs),
    Insert(verb::InsertArgs),
    Update(verb::UpdateArgs),
    Remove(verb::RemoveArgs),
    Knn(verb::KnnArgs),
    Query(verb::QueryArgs),
    Get(verb::GetArgs),
    Scan(verb::ScanArgs),
    Watch(verb::WatchArgs),
    Snapshot(verb::SnapshotArgs),
    Restore(verb::RestoreArgs),
    Verify(verb::VerifyArgs),
    Load(Box<LoadArgs>),
    /// Prints the version, the durability and the limits of the server
    Server,
    /// Checks that the server serves calls
    ///
    /// It calls grpc.health.v1.Health. The exit status is 0 if the server serves, 1 if it is starting or stopping or its
    /// store cannot be read, and 4 if there is no answer.
    Health,
    Token(verb::TokenArgs),
    Completions(verb::CompletionsArgs),
    Man(verb::ManArgs),
}

impl Args {
    /// The arguments of the process, if they agree with each other.
    pub(super) fn read() -> Result<Args, clap::Error> {
        let matches = command().try_get_matches().map_err(without_variables)?;
        let mut args =
            Args::from_arg_matches(&matches).map_err(|error| error.format(&mut command()))?;
        let refused = |problem| Err(Args::command().error(ErrorKind::ArgumentConflict, problem));
        if args.server.len() > 1 && !matches!(args.command, Command::Verify(_)) {
            return refused("--server is given more than once, which only verify takes");
        }
        // If an option stands on both sides of a verb, clap ignores the values before it.
        if env::args_os().filter(is_server).count() > args.server.len() {
            return refused("give every --server before the verb, or every one after it");
        }
        args.connection.note_variables(&matches);
        Ok(args)
    }
}

/// Parses the arguments again without the variables: the usage line of this error names only options that were typed.
fn without_variables(error: clap::Error) -> clap::Error {
    // The help names the variables.
    let is_help = error.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand;
    if is_help || !error.use_stderr() {
        return error;
    }
    let command = Args::command().mut_args(|arg| arg.env(Resettable::Reset));
    command.try_get_matches().err().unwrap_or(error)
}

/// The arguments, whose variables count as unset if they are empty, as in the library.
fn command() -> clap::Command {
    Args::command().mut_args(|arg| {
        let is_empty = |name| env::var_os(name).is_some_and(|value| value.is_empty());
        match arg.get_env().is_some_and(is_empty) {
            true => arg.env(Resettable::Reset),
            false => arg,
        }
    })
}

impl Args {
    /// The format of results and errors.
    pub(super) fn format(&self) -> Format {
        match &self.command {
            Command::Load(load) if load.is_json() => Format::Json,
            _ => self.output,
        }
    }
}

fn is_server(argument: &OsString) -> bool {
    let bytes = argument.as_encoded_bytes();
    bytes == b"--server" || bytes.starts_with(b"--server=")
}

/// True if the arguments ask for JSON. It serves arguments that clap cannot parse.
pub(super) fn output_is_json() -> bool {
    let args: Vec<OsString> = env::args_os().collect();
    args.iter()
        .any(|argument| argument == "--output=json" || argument == "--json")
        || args.windows(2).any(|pair| pair == ["--output", "json"])
}
