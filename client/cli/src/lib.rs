//! The command line `wayfold`: one verb a file.
//!
//! Results go to standard output, errors and progress to standard error. The exit status is documented in the help
//! text. Nothing here knows the protocol: every verb consists of calls of the library.

mod args;
mod atomic_file;
mod connection;
mod failure;
mod input;
mod interrupt;
mod load;
mod options;
mod output;
mod parse;
mod progress;
mod status;
mod verb;

use std::{
    io::{self, Write},
    process::ExitCode,
    time::Duration,
};

use args::{Args, Command};
use failure::{ErrorLine, Failure};
use output::{Format, Output};
use status::Status;
use wayfold::{Client, IndexHandle, RetryPolicy};

/// Reads the arguments of the process, runs the command, and returns the exit status.
pub fn main() -> ExitCode {
    let args = match Args::read() {
        Ok(args) => args,
        Err(error) => return refuse(&error).into(),
    };
    let format = args.format();
    match allow_broken_pipe(run(args)) {
        Ok(()) => Status::Success.into(),
        Err(failure) => {
            let mut stderr = io::stderr();
            // The error cannot be reported if standard error is closed.
            let _ = match format {
                Format::Text => writeln!(stderr, "error: {failure}"),
                Format::Json => output::json_line(&mut stderr, &ErrorLine::of(&failure)),
            };
            failure.status().into()
        }
    }
}

/// A reader of the output that has closed it, as `head` does, is no failure.
fn allow_broken_pipe(printed: Result<(), Failure>) -> Result<(), Failure> {
    printed.or_else(|failure| match failure.is_broken_pipe() {
        true => Ok(()),
        false => Err(failure),
    })
}

/// Prints the error of the arguments. Help and version take this way too, and are no errors.
fn refuse(error: &clap::Error) -> Status {
    let is_error = error.use_stderr();
    // The error cannot be reported if the output is closed.
    let _ = if is_error && args::output_is_json() {
        let message = error.render().to_string();
        let message = message.strip_prefix("error: ").unwrap_or(&message);
        output::json_line(&mut io::stderr(), &failure::usage_line(message.trim_end()))
    } else {
        error.print()
    };
    if is_error {
        Status::Usage
    } else {
        Status::Success
    }
}

fn run(args: Args) -> Result<(), Failure> {
    // These call no server.
    match &args.command {
        Command::Completions(completions) => return verb::completions(completions),
        Command::Man(man) => return verb::man(man),
        Command::Token(token) => return verb::token(token, args.format()),
        _ => {}
    }
    // Two threads: the connection stays alive while the command waits for standard input.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build();
    let runtime = runtime.map_err(Failure::Runtime)?;
    let done = runtime.block_on(execute(args));
    // A thread that reads standard input may wait for longer than the outcome.
    runtime.shutdown_background();
    done
}

/// The connections and the output that every verb works with.
struct Context {
    client: Client,
    /// The other servers, if `--server` names several.
    others: Vec<Client>,
    output: Output,
}

impl Context {
    async fn index(&self, name: &str) -> Result<IndexHandle, Failure> {
        Ok(self.client.index(name).await?)
    }
}

async fn execute(args: Args) -> Result<(), Failure> {
    let mut output = Output::stdout(args.format());
    if let Command::Load(load) = args.command {
        let to = (&*args.server, &args.connection);
        let done = load::load(*load, to, args.timeout, &mut output).await;
        return finish(done, &mut output, args.timeout);
    }
    args.connection.warn(&args.server, args.format());
    let builder = Client::builder()
        .timeout(args.timeout)
        .retry(RetryPolicy::until_deadline())
        .credentials(args.connection.credentials()?);
    let connect = async |server: &str| {
        let connected = builder.clone().connect(server).await;
        connected.map_err(|error| Failure::from(error).explained(args.timeout))
    };
    let (first, rest) = args.server.split_first().ok_or(Failure::NoServer)?;
    let client = connect(first).await?;
    let mut others = Vec::new();
    for server in rest {
        others.push(connect(server).await?);
    }
    let mut context = Context {
        client,
        others,
        output,
    };
    let context = &mut context;
    let done = match args.command {
        Command::Create(args) => verb::create(args, context).await,
        Command::List => verb::list(context).await,
        Command::Info(args) => verb::info(args, context).await,
        Command::Delete(args) => verb::delete(args, context).await,
        Command::Insert(args) => verb::insert(args, context).await,
        Command::Update(args) => verb::update(args, context).await,
        Command::Remove(args) => verb::remove(args, context).await,
        Command::Knn(args) => verb::knn(args, context).await,
        Command::Query(args) => verb::query(args, context).await,
        Command::Get(args) => verb::get(args, context).await,
        Command::Scan(args) => verb::scan(args, context).await,
        Command::Watch(args) => verb::watch(args, context).await,
        Command::Snapshot(args) => verb::snapshot(args, context).await,
        Command::Restore(args) => verb::restore(args, context).await,
        Command::Verify(args) => verb::verify(args, context).await,
        Command::Server => verb::server(context).await,
        Command::Health => verb::health(context).await,
        Command::Completions(_) | Command::Man(_) | Command::Token(_) | Command::Load(_) => Ok(()),
    };
    finish(done, &mut context.output, args.timeout)
}

/// Prints the results, also those that came before an error.
fn finish(
    done: Result<(), Failure>,
    output: &mut Output,
    timeout: Duration,
) -> Result<(), Failure> {
    let flushed = output.flush();
    done.map_err(|failure| failure.explained(timeout))?;
    Ok(flushed?)
}
