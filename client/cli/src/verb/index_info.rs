//! `wayfold info` and `wayfold list`

use std::io;

use indicatif::HumanBytes;
use serde::Serialize;

use crate::{
    Context, allow_broken_pipe,
    failure::Failure,
    output::{Column, Format, JsonRevision, Output, table},
};
use wayfold::{DamagedIndex, IndexInfo, IndexList, PayloadEncoding, coordinate_names};

/// Describes an index
#[derive(Debug, clap::Args)]
pub(crate) struct InfoArgs {
    /// The index
    name: String,
}

/// A damaged index as a line of JSON.
#[derive(Serialize)]
struct DamagedLine<'a> {
    name: &'a str,
    uid: &'a str,
    error: ErrorLine<'a>,
}

#[derive(Serialize)]
struct ErrorLine<'a> {
    code: &'static str,
    reason: &'a str,
    message: &'a str,
}

impl DamagedLine<'_> {
    fn of(index: &DamagedIndex) -> DamagedLine<'_> {
        let error = &index.error;
        DamagedLine {
            name: &index.name,
            uid: &index.uid,
            error: ErrorLine {
                code: error.code_name(),
                reason: &error.reason,
                message: &error.message,
            },
        }
    }
}

/// An index as a line of JSON.
#[derive(Serialize)]
pub(super) struct InfoLine<'a> {
    name: &'a str,
    space_text: String,
    point_count: u64,
    revision: JsonRevision<'a>,
    coordinate_count: usize,
    dimension: usize,
    memory_bytes: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    payload_encoding: Option<&'static str>,
}

/// The name of a declared encoding, as `wayfold create` takes it.
fn encoding_name(index: &IndexInfo) -> Option<&'static str> {
    match index.payload_encoding {
        PayloadEncoding::Unspecified => None,
        PayloadEncoding::Edges => Some("edges"),
        PayloadEncoding::WeightedEdges => Some("weighted-edges"),
    }
}

impl InfoLine<'_> {
    pub(super) fn of(index: &IndexInfo) -> InfoLine<'_> {
        InfoLine {
            name: &index.name,
            space_text: index.space.to_string(),
            point_count: index.point_count,
            revision: (&index.revision).into(),
            coordinate_count: index.coordinate_count,
            dimension: index.dimension,
            memory_bytes: index.memory_bytes,
            payload_encoding: encoding_name(index),
        }
    }
}

pub(crate) async fn info(args: InfoArgs, context: &mut Context) -> Result<(), Failure> {
    let index = context.client.index_info(&args.name).await?;
    let output = &mut context.output;
    if output.format == Format::Json {
        return Ok(output.json(&InfoLine::of(&index))?);
    }
    output.text(format_args!("name         {}", index.name))?;
    output.text(format_args!("space        {}", index.space))?;
    output.text(format_args!("points       {}", index.point_count))?;
    output.text(format_args!("revision     {}", index.revision.number))?;
    output.text(format_args!("uid          {}", index.revision.uid))?;
    let row = coordinate_names(&index.space).join(", ");
    output.text(format_args!(
        "coordinates  {} ({row})",
        index.coordinate_count
    ))?;
    output.text(format_args!("dimension    {}", index.dimension))?;
    output.text(format_args!(
        "memory       {}",
        HumanBytes(index.memory_bytes)
    ))?;
    if let Some(encoding) = encoding_name(&index) {
        output.text(format_args!("payloads     {encoding}"))?;
    }
    Ok(())
}

pub(crate) async fn list(context: &mut Context) -> Result<(), Failure> {
    let IndexList {
        indexes, damaged, ..
    } = context.client.list_indexes().await?;
    let printed = print_list(&indexes, &damaged, &mut context.output);
    // A reader that leaves does not hide the damage.
    allow_broken_pipe(printed.map_err(Failure::from))?;
    check(indexes.len(), damaged.len())
}

fn print_list(
    indexes: &[IndexInfo],
    damaged: &[DamagedIndex],
    output: &mut Output,
) -> io::Result<()> {
    if output.format == Format::Json {
        for index in indexes {
            output.json(&InfoLine::of(index))?;
        }
        for index in damaged {
            output.json(&DamagedLine::of(index))?;
        }
        return Ok(());
    }
    if indexes.is_empty() && damaged.is_empty() {
        output.text("no indices; `wayfold create NAME --space SPACE` creates one")?;
    }
    if !indexes.is_empty() {
        print_table(indexes, output)?;
    }
    for index in damaged {
        output.text(format_args!("{} is damaged: {}", index.name, index.error))?;
    }
    Ok(())
}

/// A damaged index in the list is a failure, so that a script can rely on the exit status.
fn check(readable: usize, damaged: usize) -> Result<(), Failure> {
    match damaged {
        0 => Ok(()),
        damaged => Err(Failure::Damaged {
            damaged,
            all: readable + damaged,
        }),
    }
}

fn print_table(indexes: &[IndexInfo], output: &mut Output) -> io::Result<()> {
    let columns = [
        Column::new("NAME", false, indexes.iter().map(|index| &index.name)),
        Column::new(
            "POINTS",
            true,
            indexes.iter().map(|index| index.point_count),
        ),
        Column::new(
            "REVISION",
            true,
            indexes.iter().map(|index| index.revision.number),
        ),
        Column::new("SPACE", false, indexes.iter().map(|index| &index.space)),
    ];
    table(output, "", &columns)
}
