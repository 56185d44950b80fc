//! `wayfold delete`

use serde::Serialize;

use crate::{Session, failure::Failure, output::Format};

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

pub(crate) async fn delete(args: DeleteArgs, session: &mut Session) -> Result<(), Failure> {
    let uid = session.client.delete_index(&args.name).await?;
    match session.output.format {
        Format::Json => session.output.json(&Deleted {
            name: &args.name,
            uid: &uid,
            deleted: true,
        })?,
        Format::Text => session
            .output
            .text(format_args!("deleted {} (uid {uid})", args.name))?,
    }
    Ok(())
}
