//! `wayfold scan`

use std::{
    fs::File,
    io,
    path::{Path, PathBuf},
};

use serde::Serialize;

use super::get::PointLine;
use crate::{
    Session,
    failure::Failure,
    output::{Format, Output, Row},
    progress,
};
use wayfold::{Point, Scan, coordinate_names};

const EXAMPLES: &str = "\
Examples:
  wayfold scan arm roadmap.csv
  wayfold scan arm | head
  wayfold scan arm --output json

As CSV there is a header, and then a row a point: its id and its state in canonical form, which
`wayfold insert NAME FILE --ids id` reads back. A file is always CSV. On standard output, with
--output json, a point is a line {\"id\":...,\"state\":[...],\"tag\":...,\"revision\":...}. All
points are of one revision, in the order of their ids.";

/// Writes all points as CSV
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct ScanArgs {
    /// The index
    name: String,
    /// The file to write; standard output without it
    #[arg(value_name = "FILE", value_parser = file)]
    file: Option<PathBuf>,
}

fn file(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension() {
        Some(extension) if extension.eq_ignore_ascii_case("npy") => {
            Err("a scan is written as CSV, which has a column for the ids".to_owned())
        }
        _ => Ok(path),
    }
}

#[derive(Serialize)]
struct Written {
    points: u64,
    revision: u64,
}

pub(crate) async fn scan(args: ScanArgs, session: &mut Session) -> Result<(), Failure> {
    let index = session.index(&args.name).await?;
    let scan = index.scan().await?;
    let revision = scan.revision().number;
    let mut header = vec!["id".to_owned()];
    header.extend(coordinate_names(index.space()));
    let header = header.join(",");
    let path = match args.file {
        Some(path) if path != Path::new("-") => path,
        _ => {
            write(scan, &header, &mut session.output, true, Failure::Output).await?;
            return Ok(());
        }
    };
    let failed = |source| Failure::File {
        path: path.clone(),
        source,
    };
    let mut output = Output::to(Format::Text, File::create(&path).map_err(failed)?);
    let points = write(scan, &header, &mut output, false, failed).await?;
    match session.output.format {
        Format::Json => session.output.json(&Written { points, revision })?,
        Format::Text => {
            let path = path.display();
            session.output.text(format_args!(
                "{points} points at revision {revision} written to {path}"
            ))?;
        }
    }
    Ok(())
}

/// Writes all points, and tells how many there were.
async fn write(
    mut scan: Scan,
    header: &str,
    output: &mut Output,
    prints: bool,
    failed: impl Fn(io::Error) -> Failure,
) -> Result<u64, Failure> {
    let bar = progress::bar(Some(scan.point_count()), "scanning", prints);
    if output.format == Format::Text {
        output.text(header).map_err(&failed)?;
    }
    let mut points = 0;
    while let Some(part) = scan
        .next()
        .await
        .map_err(|error| stopped(points, error.into()))?
    {
        for point in part.iter() {
            write_point(output, point).map_err(&failed)?;
        }
        points += part.len() as u64;
        bar.set_position(points);
    }
    output.flush().map_err(&failed)?;
    bar.finish_and_clear();
    Ok(points)
}

/// Says that what was written is not all.
fn stopped(points: u64, failure: Failure) -> Failure {
    Failure::Stopped {
        done: format!("only {points} points were written"),
        source: Box::new(failure),
    }
}

fn write_point(output: &mut Output, point: Point<'_>) -> io::Result<()> {
    match output.format {
        Format::Json => output.json(&PointLine::of(point)),
        Format::Text => output.text(format_args!("{},{}", point.id, Row(point.state))),
    }
}
