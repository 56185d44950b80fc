//! `wayfold update`

use clap::ArgGroup;
use serde::Serialize;

use crate::{
    Session,
    failure::Failure,
    output::Format,
    parse::{self, MaskedTag},
};

const EXAMPLES: &str = "\
Examples:
  wayfold update arm 17 18 --tag 3                     the whole tag
  wayfold update arm 17 --tag 0x100/0x100              one bit, whatever the others are
  wayfold update arm 17 --payload 'gripper open' --if-revision 42

A call that changes nothing makes no revision.";

/// Sets the tag or the payload of stored points; their states stay
#[derive(Debug, clap::Args)]
#[command(
    after_help = EXAMPLES,
    group = ArgGroup::new("change").required(true).multiple(true).args(["tag", "payload"])
)]
pub(crate) struct UpdateArgs {
    /// The index
    name: String,
    /// The points
    #[arg(value_name = "ID", required = true, value_parser = parse::id)]
    ids: Vec<u64>,
    /// The new tag; with a mask, only the bits of the mask change
    #[arg(long, value_name = "VALUE[/MASK]", value_parser = parse::masked_tag)]
    tag: Option<MaskedTag>,
    /// The new payload, as UTF-8; '' removes it
    #[arg(long, value_name = "TEXT")]
    payload: Option<String>,
    /// Fail if one of the points changed after this revision
    #[arg(long, value_name = "REVISION")]
    if_revision: Option<u64>,
}

#[derive(Serialize)]
struct UpdatedLine {
    updated: u64,
    unchanged: u64,
    revision: u64,
}

pub(crate) async fn update(args: UpdateArgs, session: &mut Session) -> Result<(), Failure> {
    let points = args.ids.len();
    let mut update = session.index(&args.name).await?.update(args.ids);
    if let Some(MaskedTag { value, mask }) = args.tag {
        update = update.tags([value]);
        if mask != u64::MAX {
            update = update.tag_mask(mask);
        }
    }
    if let Some(payload) = args.payload {
        update = update.payloads(vec![payload; points]);
    }
    if let Some(revision) = args.if_revision {
        update = update.if_revision(revision);
    }
    let done = update.await?;
    match session.output.format {
        Format::Json => session.output.json(&UpdatedLine {
            updated: done.updated,
            unchanged: done.unchanged,
            revision: done.revision,
        })?,
        Format::Text => session.output.text(format_args!(
            "updated {}, unchanged {}; revision {}",
            done.updated, done.unchanged, done.revision
        ))?,
    }
    Ok(())
}
