//! `wayfold watch`

use std::{io, time::UNIX_EPOCH};

use serde::Serialize;

use super::get::PointLine;
use crate::{
    Context,
    failure::Failure,
    options::{self, IncludeArgs, POINT_COLUMNS},
    output::{Format, JsonIds, JsonRevision, Output},
    parse::{self, RevisionArg},
};
use wayfold::{Include, IndexHandle, Mutation, Reset, ResetReason, Revision, WatchEvent};

const EXAMPLES: &str = "\
Examples:
  wayfold watch arm
  wayfold watch arm --after 0 --output json | jq -c .removed_ids

Prints a line for each mutation as soon as reads can see it, until Ctrl-C. In JSON the line holds
the stored points and the removed ids: {\"revision\":{\"uid\":...,\"number\":N},\"time_ms\":...,
\"stored\":[{\"id\":...,\"state\":[...],...}],\"removed_ids\":[...]}. The exit status is 3 if the
next mutation is not available: the index was deleted or created again, or the server no longer
keeps mutations that old. If the server ends, the watch goes on at another one that --server
names, or at the same one once it is back within --timeout.";

/// Prints the mutations of an index as they happen
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct WatchArgs {
    /// The index
    name: String,
    /// Begin with the mutation after this revision, instead of the next one
    #[arg(long, value_name = "NUMBER[@UID]", value_parser = parse::revision)]
    after: Option<RevisionArg>,
    #[command(flatten)]
    include: IncludeArgs,
}

/// A mutation as a line of JSON.
#[derive(Serialize)]
struct MutationLine<'a> {
    revision: JsonRevision<'a>,
    time_ms: u64,
    stored: Vec<PointLine<'a>>,
    removed_ids: JsonIds<'a>,
}

pub(crate) async fn watch(args: WatchArgs, context: &mut Context) -> Result<(), Failure> {
    let index = context.index(&args.name).await?;
    let include = args.include.include_or(POINT_COLUMNS);
    let after = args.after.as_ref();
    let after = after.map(|after| options::revision(after, &index));
    tokio::select! {
        ended = print_all(&index, after, include, &mut context.output) => ended,
        // Only whole lines were printed.
        interrupted = tokio::signal::ctrl_c() => Ok(interrupted?),
    }
}

/// Prints the mutations after a revision, or after the newest one.
async fn print_all(
    index: &IndexHandle,
    after: Option<Revision>,
    include: Include,
    output: &mut Output,
) -> Result<(), Failure> {
    let request = index.watch().include(include);
    let request = match after {
        Some(after) => request.after(after),
        None => request,
    };
    let mut watch = request.await?;
    while let Some(event) = watch.next().await? {
        match event {
            WatchEvent::Mutation(mutation) => print(output, &mutation, include)?,
            WatchEvent::Reset(reset) => {
                let (reason, problem) = describe(&reset);
                return Err(Failure::Reset { reason, problem });
            }
        }
        // A reader may wait for this line.
        output.flush()?;
    }
    Ok(())
}

fn print(output: &mut Output, mutation: &Mutation, include: Include) -> io::Result<()> {
    let Mutation {
        revision,
        stored,
        removed_ids,
        ..
    } = mutation;
    match output.format {
        Format::Json => {
            let time = mutation.time.duration_since(UNIX_EPOCH).unwrap_or_default();
            output.json(&MutationLine {
                revision: revision.into(),
                time_ms: u64::try_from(time.as_millis()).unwrap_or(u64::MAX),
                stored: stored
                    .iter()
                    .map(|point| PointLine::of(point, &revision.uid, include))
                    .collect(),
                removed_ids: JsonIds(removed_ids),
            })
        }
        Format::Text => output.text(format_args!(
            "revision {}  {} stored  {} removed",
            revision.number,
            stored.len(),
            removed_ids.len()
        )),
    }
}

/// The reason and the message of a reset.
fn describe(reset: &Reset) -> (&'static str, String) {
    let Revision { uid, number } = &reset.revision;
    match reset.reason {
        ResetReason::UidChanged => (
            "UID_CHANGED",
            format!("the index was created again or restored: its uid is now {uid}"),
        ),
        ResetReason::WindowPassed => (
            "WINDOW_PASSED",
            format!(
                "the server no longer keeps the next mutation; the index is at revision {number}"
            ),
        ),
        ResetReason::Other(reason) => (
            "RESET",
            format!("the server cannot send the next mutation (reset {reason})"),
        ),
    }
}
