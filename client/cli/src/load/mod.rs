//! `wayfold load`: calls an index as many workers would, and measures the answers.
//!
//! `settings` and `scenario` say what to do, `run` does it with a thread for each `worker`. A worker takes its calls from
//! the `schedule`, draws them (`mix`, `states`), makes them through its own `target` and records what becomes of them
//! (`record`); the `collector` makes steps of a second of that. The `outcome` is printed by `table` or `json`, and shown by `report`.

mod collector;
mod error;
mod json;
mod machine;
mod mix;
mod outcome;
mod record;
mod report;
mod run;
mod scenario;
mod schedule;
mod settings;
mod states;
mod table;
mod target;
mod worker;

use std::{
    path::PathBuf,
    sync::{Arc, atomic::Ordering::Relaxed},
    thread,
    time::Duration,
};

use tokio::sync::{oneshot, watch};

use crate::{
    allow_broken_pipe,
    connection::ConnectionArgs,
    failure::Failure,
    interrupt,
    output::{Format, Output},
    progress,
};
pub(crate) use error::LoadError;
use outcome::Outcome;
use report::ReportFile;
use run::Plan;
use scenario::Scenario;
use settings::{Address, PhaseSettings, RunSettings};

fn after_long_help() -> String {
    format!("{EXAMPLES}\n\n{}", json::FIELDS)
}

const EXAMPLES: &str = "\
What it does to the index: inserts store points, which every client of the index finds during
the run. They carry a tag that no other run has. At the end the command removes all points
with this tag, also after Ctrl-C; --keep leaves them. An empty index gets 1000 such points
before a mix that reads (--fill).

With --rate the loop is open: calls are due at even distances, and the latency counts from the
due time, so that a call that waits for a worker counts as late. Calls of the rest of the time
that no worker began are shown as never begun. Without it the loop is closed: a slow server
gets fewer calls.

Calls are made once, without the retries of the client. Failed calls are counted by kind and
reason: refused by the server, expired (--timeout), lost with the connection, or failed
otherwise. A worker of a closed loop pauses after a refusal for as long as the server asks, a
second at most.

Examples:
  wayfold load arm --duration 30s                          as fast as 8 workers go
  wayfold load arm --rate 500 --duration 30s --report arm.html
  wayfold load arm --mix insert=1,knn=20 --batch 100 -k 5 --workers 32
  wayfold load arm --face zenoh --locator tcp/127.0.0.1:7448
  wayfold load arm --scenario ramp.toml --json             phases, one after the other";

/// Calls an index as many workers would, and measures the answers
///
/// It prints the rate, the latencies and the failures of each verb. The points that it stores are removed at the end.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = after_long_help())]
pub(crate) struct LoadArgs {
    /// The index
    name: String,
    #[command(flatten, next_help_heading = "Calls")]
    phase: PhaseSettings,
    #[command(flatten, next_help_heading = "Run")]
    run: RunSettings,
    /// A file with these settings and with phases; options of the command line go before it
    ///
    /// The keys are the names of the options. A phase begins with a line [[phase]], and has a name.
    #[arg(long, value_name = "FILE.toml")]
    scenario: Option<PathBuf>,
    /// Writes the result as a page with charts; the file is replaced
    #[arg(long, value_name = "FILE.html")]
    report: Option<PathBuf>,
    /// Prints the result as one JSON object, as --output json does
    #[arg(long)]
    json: bool,
}

impl LoadArgs {
    pub(crate) fn is_json(&self) -> bool {
        self.json
    }
}

pub(crate) async fn load(
    args: LoadArgs,
    (servers, connection): (&[String], &ConnectionArgs),
    timeout: Duration,
    output: &mut Output,
) -> Result<(), Failure> {
    let scenario = match &args.scenario {
        Some(path) => Scenario::read(path)?,
        None => Scenario::default(),
    };
    let phases = scenario.phases(&args.phase);
    let settings = args.run.or(scenario.run);
    let server = servers.first().ok_or(Failure::NoServer)?;
    let address = settings.address(server)?;
    connection.warn(std::slice::from_ref(&address.server), output.format);
    let plan = Plan {
        index: args.name,
        address: Address {
            credentials: connection.credentials()?,
            zenoh_tls: connection.zenoh_tls(),
            ..address
        },
        phases,
        warmup: settings.warmup,
        range: settings.range(),
        seed: settings.seed(),
        fill: settings.fill,
        keep: settings.keep,
        timeout,
        tag: run::fresh_tag(),
        has_begun: Arc::default(),
        may_leave: Arc::default(),
    };
    let report = args.report.as_deref().map(ReportFile::open).transpose()?;
    let (outcome, cleaned) = run_until_signal(plan).await?;
    let reported = tell(&outcome, report, output);
    // Points that are left behind matter more than figures that cannot be written, and a reader that leaves hides no failure.
    let reported = allow_broken_pipe(reported);
    cleaned.and(reported).and_then(|()| complete(&outcome))
}

/// Writes the figures, and the report if there is one.
fn tell(outcome: &Outcome, report: Option<ReportFile>, output: &mut Output) -> Result<(), Failure> {
    let report = report.map(|report| report.write(&report::page(outcome)));
    let printed = match output.format {
        Format::Json => output.json(&json::object(outcome)),
        Format::Text => table::print(outcome, output),
    };
    // The figures are printed, even if the page cannot be written.
    let page = report.transpose()?;
    printed?;
    if let (Some(path), Format::Text) = (page, output.format) {
        output.text(format_args!("the report is in {}", path.display()))?;
    }
    Ok(())
}

/// Runs a plan on a thread of its own. The first signal ends the run, the second also the removal of its points. Before
/// the run has begun, the first one ends all.
async fn run_until_signal(plan: Plan) -> Result<(Outcome, Result<(), Failure>), Failure> {
    let interrupted = interrupt::listen().map_err(Failure::Runtime)?;
    let (stop, stopped) = watch::channel(false);
    let (send, mut done) = oneshot::channel();
    let line = progress::line();
    let (index, tag) = (plan.index.clone(), plan.tag);
    let (has_begun, may_leave) = (Arc::clone(&plan.has_begun), Arc::clone(&plan.may_leave));
    let run_line = line.clone();
    let spawned = thread::Builder::new()
        .name("load".to_owned())
        .spawn(move || {
            // The receiver is gone after a second signal.
            let _ = send.send(run::run(plan, stopped, &run_line));
        });
    spawned.map_err(|source| LoadError::Thread { source })?;
    let ended = tokio::select! {
        ended = &mut done => ended,
        () = interrupted => {
            stop.send_replace(true);
            if !has_begun.load(Relaxed) {
                return Err(Failure::Interrupted);
            }
            let interrupted = interrupt::listen().map_err(Failure::Runtime)?;
            tokio::select! {
                ended = &mut done => ended,
                () = interrupted => {
                    let problem = "a second signal ended the command".to_owned();
                    return Err(match may_leave.load(Relaxed) {
                        true => LoadError::Left { index, tag, problem },
                        false => LoadError::Interrupted,
                    }.into());
                }
            }
        }
    };
    line.finish_and_clear();
    ended.map_err(|_| LoadError::Worker)?
}

/// A run that a signal ended, or without any answer, is a failure, so that a script can rely on the exit status.
fn complete(outcome: &Outcome) -> Result<(), Failure> {
    if outcome.is_interrupted {
        return Err(LoadError::Interrupted.into());
    }
    let total = outcome.total().total();
    match total.failures.values().next() {
        Some(failures) if total.answered() == 0 => Err(LoadError::NoAnswer {
            calls: total.made(),
            first: failures.first.clone(),
        }
        .into()),
        _ => Ok(()),
    }
}
