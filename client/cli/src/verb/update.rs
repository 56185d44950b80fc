//! `wayfold update`

use clap::ArgGroup;
use serde::Serialize;

use crate::{
    Context,
    failure::Failure,
    options,
    output::{Format, JsonRevision},
    parse::{self, MaskedTag, RevisionArg},
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
    #[arg(long, value_name = "NUMBER[@UID]", value_parser = parse::revision)]
    if_revision: Option<RevisionArg>,
}

#[derive(Serialize)]
struct UpdatedLine<'a> {
    updated_count: u64,
    unchanged_count: u64,
    revision: JsonRevision<'a>,
}

pub(crate) async fn update(args: UpdateArgs, context: &mut Context) -> Result<(), Failure> {
    let points = args.ids.len();
    let index = context.index(&args.name).await?;
    let mut update = index.update(args.ids);
    if let Some(MaskedTag { value, mask }) = args.tag {
        update = update.tags([value]);
        if mask != u64::MAX {
            update = update.tag_mask(mask);
        }
    }
    if let Some(payload) = args.payload {
        update = update.payloads(vec![payload; points]);
    }
    if let Some(revision) = &args.if_revision {
        update = update.if_revision(options::revision(revision, &index));
    }
    let done = update.await?;
    match context.output.format {
        Format::Json => context.output.json(&UpdatedLine {
            updated_count: done.updated_count,
            unchanged_count: done.unchanged_count,
            revision: (&done.revision).into(),
        })?,
        Format::Text => context.output.text(format_args!(
            "updated {}, unchanged {}; revision {}",
            done.updated_count, done.unchanged_count, done.revision.number
        ))?,
    }
    Ok(())
}
