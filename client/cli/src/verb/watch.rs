//! `wayfold watch`

use std::{io, time::UNIX_EPOCH};

use serde::Serialize;

use super::get::PointLine;
use crate::{
    Session,
    failure::Failure,
    output::{Format, JsonIds, Output},
};
use wayfold::{Mutation, Reset, ResetReason, Watch, WatchEvent};

const EXAMPLES: &str = "\
Examples:
  wayfold watch arm
  wayfold watch arm --after 0 --output json | jq -c .removed_ids

A line a mutation, as soon as readers can see it, until Ctrl-C. In JSON it has the stored points and
the removed ids: {\"revision\":...,\"time_ms\":...,\"stored\":[{\"id\":...,\"state\":[...],...}],
\"removed_ids\":[...]}. The exit status is 1 if what comes next cannot be told: the index was deleted
or made anew, or the server does not keep the mutations that far back.";

/// Prints the mutations of an index as they happen
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct WatchArgs {
    /// The index
    name: String,
    /// Begins with the mutation after this revision, instead of with the next one
    #[arg(long, value_name = "REV")]
    after: Option<u64>,
}

/// A mutation as a line of JSON.
#[derive(Serialize)]
struct MutationLine<'a> {
    revision: u64,
    time_ms: u64,
    stored: Vec<PointLine<'a>>,
    removed_ids: JsonIds<'a>,
}

pub(crate) async fn watch(args: WatchArgs, session: &mut Session) -> Result<(), Failure> {
    let index = session.index(&args.name).await?;
    let request = match args.after {
        Some(revision) => index.watch().after(index.revision_at(revision)),
        None => index.watch(),
    };
    let watch = request.await?;
    tokio::select! {
        ended = print_all(watch, &mut session.output) => ended,
        // What was printed is whole lines.
        interrupted = tokio::signal::ctrl_c() => Ok(interrupted?),
    }
}

async fn print_all(mut watch: Watch, output: &mut Output) -> Result<(), Failure> {
    while let Some(event) = watch.next().await? {
        match event {
            WatchEvent::Mutation(mutation) => print(output, &mutation)?,
            WatchEvent::Reset(reset) => {
                return Err(Failure::Reset {
                    what: words(&reset),
                });
            }
        }
        // Somebody waits for this line.
        output.flush()?;
    }
    Ok(())
}

fn print(output: &mut Output, mutation: &Mutation) -> io::Result<()> {
    let Mutation {
        revision,
        stored,
        removed_ids,
        ..
    } = mutation;
    let revision = revision.number;
    match output.format {
        Format::Json => {
            let time = mutation.time.duration_since(UNIX_EPOCH).unwrap_or_default();
            output.json(&MutationLine {
                revision,
                time_ms: u64::try_from(time.as_millis()).unwrap_or(u64::MAX),
                stored: stored.iter().map(PointLine::of).collect(),
                removed_ids: JsonIds(removed_ids),
            })
        }
        Format::Text => output.text(format_args!(
            "revision {revision}  {} stored  {} removed",
            stored.len(),
            removed_ids.len()
        )),
    }
}

fn words(reset: &Reset) -> String {
    let (uid, revision) = (&reset.revision.uid, reset.revision.number);
    match reset.reason {
        ResetReason::UidChanged => format!("the index was made anew: its uid is {uid} now"),
        ResetReason::WindowPassed => format!(
            "the server does not keep the next mutation any more; the index is at revision {revision}"
        ),
        ResetReason::Other(reason) => {
            format!("the server cannot tell the next mutation (reset {reason})")
        }
    }
}
