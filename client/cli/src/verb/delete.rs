//! `wayfold delete`

use serde::Serialize;

use crate::{Context, failure::Failure, output::Format};

/// Deletes an index with all its points
#[derive(Debug, clap::Args)]
pub(crate) struct DeleteArgs {
    /// The index
    name: String,
}

#[derive(Serialize)]
struct Deleted<'a> {
    name: &'a str,
    uid: &'a str,
    deleted: bool,
}

pub(crate) async fn delete(args: DeleteArgs, context: &mut Context) -> Result<(), Failure> {
    let uid = context.client.delete_index(&args.name).await?;
    match context.output.format {
        Format::Json => context.output.json(&Deleted {
            name: &args.name,
            uid: &uid,
            deleted: true,
        })?,
        Format::Text => context
            .output
            .text(format_args!("deleted {} (uid {uid})", args.name))?,
    }
    Ok(())
}
