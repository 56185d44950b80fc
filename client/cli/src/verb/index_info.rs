//! `wayfold info` and `wayfold list`

use std::io;

use indicatif::HumanBytes;
use serde::Serialize;

use crate::{
    Session,
    failure::Failure,
    output::{Format, Output},
};
use wayfold::{DamagedIndex, IndexInfo, IndexList, coordinate_names};

/// Describes an index
#[derive(Debug, clap::Args)]
pub(crate) struct InfoArgs {
    /// The index
    name: String,
}

/// An index that cannot be read as a line of JSON.
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
    space: String,
    points: u64,
    revision: u64,
    uid: &'a str,
    coordinates: usize,
    dimension: usize,
    memory_bytes: u64,
}

impl InfoLine<'_> {
    pub(super) fn of(index: &IndexInfo) -> InfoLine<'_> {
        InfoLine {
            name: &index.name,
            space: index.space.to_string(),
            points: index.point_count,
            revision: index.revision.number,
            uid: &index.revision.uid,
            coordinates: index.coordinate_count,
            dimension: index.dimension,
            memory_bytes: index.memory_bytes,
        }
    }
}

pub(crate) async fn info(args: InfoArgs, session: &mut Session) -> Result<(), Failure> {
    let index = session.client.index_info(&args.name).await?;
    let output = &mut session.output;
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
    Ok(())
}

pub(crate) async fn list(session: &mut Session) -> Result<(), Failure> {
    let IndexList {
        indexes, damaged, ..
    } = session.client.list_indexes().await?;
    let output = &mut session.output;
    if output.format == Format::Json {
        for index in &indexes {
            output.json(&InfoLine::of(index))?;
        }
        for index in &damaged {
            output.json(&DamagedLine::of(index))?;
        }
        return whole(indexes.len(), damaged.len());
    }
    if indexes.is_empty() && damaged.is_empty() {
        output.text("no indices; `wayfold create NAME --space SPACE` makes one")?;
    }
    if !indexes.is_empty() {
        table(&indexes, output)?;
    }
    for index in &damaged {
        output.text(format_args!(
            "{} cannot be read: {}",
            index.name, index.error
        ))?;
    }
    whole(indexes.len(), damaged.len())
}

/// A list with damaged indices in it is no success, so that a script that only asks for the status hears of them.
fn whole(readable: usize, damaged: usize) -> Result<(), Failure> {
    match damaged {
        0 => Ok(()),
        damaged => Err(Failure::Damaged {
            damaged,
            all: readable + damaged,
        }),
    }
}

fn table(indexes: &[IndexInfo], output: &mut Output) -> io::Result<()> {
    let longest = |text: fn(&IndexInfo) -> usize, least: usize| {
        indexes.iter().map(text).fold(least, usize::max)
    };
    let name = longest(|index| index.name.len(), "NAME".len());
    let points = longest(|index| index.point_count.to_string().len(), "POINTS".len());
    let revision = longest(
        |index| index.revision.number.to_string().len(),
        "REVISION".len(),
    );
    output.text(format_args!(
        "{:name$}  {:>points$}  {:>revision$}  SPACE",
        "NAME", "POINTS", "REVISION"
    ))?;
    for index in indexes {
        let IndexInfo {
            name: called,
            space,
            ..
        } = index;
        output.text(format_args!(
            "{called:name$}  {:>points$}  {:>revision$}  {space}",
            index.point_count, index.revision.number
        ))?;
    }
    Ok(())
}
