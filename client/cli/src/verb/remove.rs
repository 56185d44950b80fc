//! `wayfold remove`

use serde::Serialize;

use crate::{
    Context,
    failure::Failure,
    output::{Format, JsonRevision},
    parse,
};

/// Removes points
///
/// Ids that are not stored are counted, and are no error.
#[derive(Debug, clap::Args)]
pub(crate) struct RemoveArgs {
    /// The index
    name: String,
    /// The points
    #[arg(value_name = "ID", required = true, value_parser = parse::id)]
    ids: Vec<u64>,
}

#[derive(Serialize)]
struct RemovedLine<'a> {
    removed_count: u64,
    missing_count: u64,
    revision: JsonRevision<'a>,
}

pub(crate) async fn remove(args: RemoveArgs, context: &mut Context) -> Result<(), Failure> {
    let done = context.index(&args.name).await?.remove(args.ids).await?;
    match context.output.format {
        Format::Json => context.output.json(&RemovedLine {
            removed_count: done.removed_count,
            missing_count: done.missing_count,
            revision: (&done.revision).into(),
        })?,
        Format::Text => context.output.text(format_args!(
            "removed {}, missing {}; revision {}",
            done.removed_count, done.missing_count, done.revision.number
        ))?,
    }
    Ok(())
}
