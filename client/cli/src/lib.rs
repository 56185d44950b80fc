//! The command line `wayfold`: one verb a file.
//!
//! Results go to standard output and nothing else does; errors and progress go to standard error. The exit status is 0,
//! 1 for an error, 2 for wrong usage. Nothing here knows the protocol: every verb is made of calls of the library.

mod args;
mod failure;
mod input;
mod interrupt;
mod output;
mod parse;
mod progress;
mod verb;

use std::{io::Write, process::ExitCode};

use args::{Args, Command};
use failure::Failure;
use output::Output;
use wayfold::{Client, IndexHandle, RetryPolicy};

/// Reads the arguments of the process, does what they say, and tells the exit status.
pub fn main() -> ExitCode {
    let args = match Args::read() {
        Ok(args) => args,
        Err(error) => {
            // Help and version come this way too. Where standard output is gone there is nobody to tell.
            let _ = error.print();
            return ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(2));
        }
    };
    match run(args) {
        Ok(()) => ExitCode::SUCCESS,
        // Whoever read the output has seen enough of it: `| head`.
        Err(failure) if failure.is_broken_pipe() => ExitCode::SUCCESS,
        Err(failure) => {
            let _ = writeln!(std::io::stderr(), "error: {failure}");
            ExitCode::FAILURE
        }
    }
}

fn run(args: Args) -> Result<(), Failure> {
    // Two threads: the connection lives on while the command waits for standard input.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build();
    runtime.map_err(Failure::Runtime)?.block_on(execute(args))
}

/// What every verb works with.
struct Session {
    client: Client,
    /// The other servers, where several were named.
    others: Vec<Client>,
    output: Output,
}

impl Session {
    async fn index(&self, name: &str) -> Result<IndexHandle, Failure> {
        Ok(self.client.index(name).await?)
    }
}

async fn execute(args: Args) -> Result<(), Failure> {
    let builder = Client::builder()
        .timeout(args.timeout)
        .retry(RetryPolicy::until_deadline());
    let connect = async |server: &str| {
        let connected = builder.connect(server).await;
        connected.map_err(|error| Failure::unreachable(error, args.timeout))
    };
    let (first, rest) = args.server.split_first().ok_or(Failure::NoServer)?;
    let client = connect(first).await?;
    let mut others = Vec::new();
    for server in rest {
        others.push(connect(server).await?);
    }
    let mut session = Session {
        client,
        others,
        output: Output::stdout(args.output),
    };
    let done = match args.command {
        Command::Create(args) => verb::create(args, &mut session).await,
        Command::List => verb::list(&mut session).await,
        Command::Info(args) => verb::info(args, &mut session).await,
        Command::Delete(args) => verb::delete(args, &mut session).await,
        Command::Insert(args) => verb::insert(args, &mut session).await,
        Command::Knn(args) => verb::knn(args, &mut session).await,
        Command::Query(args) => verb::query(args, &mut session).await,
        Command::Get(args) => verb::get(args, &mut session).await,
        Command::Remove(args) => verb::remove(args, &mut session).await,
        Command::Scan(args) => verb::scan(args, &mut session).await,
        Command::Snapshot(args) => verb::snapshot(args, &mut session).await,
        Command::Restore(args) => verb::restore(args, &mut session).await,
        Command::Verify(args) => verb::verify(args, &mut session).await,
        Command::Watch(args) => verb::watch(args, &mut session).await,
    };
    // What was answered before an error is told.
    let flushed = session.output.flush();
    done.map_err(|failure| failure.explained(args.timeout))?;
    Ok(flushed?)
}
