//! `wayfold scan`

use std::{
    io,
    path::{Path, PathBuf},
    sync::Arc,
};

use clap::builder::{PathBufValueParser, TypedValueParser};
use serde::Serialize;

use super::get::PointLine;
use crate::{
    Context, atomic_file,
    failure::Failure,
    options::{FilterArgs, IncludeArgs, LatestArgs, POINT_COLUMNS},
    output::{Format, JsonRevision, Output, Row, json_payload},
    progress,
};
use wayfold::{Include, Point, Scan, Space, coordinate_names};

const EXAMPLES: &str = "\
Examples:
  wayfold scan arm roadmap.csv
  wayfold scan arm | head
  wayfold scan arm --output json
  wayfold scan arm new.csv --since 42 --include states,tags

CSV has a header line, then one row a point: its id and the columns of --include, by default its
state in canonical form. `wayfold insert NAME FILE --ids id` reads a file of states, with --tags tag if
the tags are included. A file is always CSV; it gets its name once it is whole, and an error or an
interrupt leaves an existing file as it was. On standard output, with --output json, a point is a line
{\"id\":...,\"state\":[...],\"tag\":...,\"revision\":{\"uid\":...,\"number\":N}}. All points are of one revision, in the
order of their ids.";

/// Writes all points as CSV
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct ScanArgs {
    /// The index
    name: String,
    /// The file to write or replace; standard output without it
    #[arg(value_name = "FILE", value_parser = PathBufValueParser::new().try_map(file))]
    file: Option<PathBuf>,
    #[command(flatten)]
    filter: FilterArgs,
    #[command(flatten)]
    include: IncludeArgs,
    #[command(flatten)]
    latest: LatestArgs,
}

fn file(path: PathBuf) -> Result<PathBuf, String> {
    match path.extension() {
        Some(extension) if extension.eq_ignore_ascii_case("npy") => {
            Err("a scan is written as CSV, which has a column for the ids".to_owned())
        }
        _ => Ok(path),
    }
}

#[derive(Serialize)]
struct Written<'a> {
    point_count: u64,
    revision: JsonRevision<'a>,
}

pub(crate) async fn scan(args: ScanArgs, context: &mut Context) -> Result<(), Failure> {
    let index = args.latest.of(context.index(&args.name).await?);
    let file = args.file.filter(|path| path != Path::new("-"));
    let is_csv = file.is_some() || context.output.format == Format::Text;
    let include = args.include.include_or(match is_csv {
        true => CSV_COLUMNS,
        false => POINT_COLUMNS,
    });
    let filter = args.filter.filter(&index);
    let scan = index.scan().filter(filter).include(include).await;
    let scan = scan.map_err(|error| args.filter.failure(&index, error))?;
    let revision = scan.revision().clone();
    let header = header(index.space(), include);
    let Some(path) = file else {
        let writer = Writer {
            output: &mut context.output,
            include,
            prints: true,
        };
        writer.write(scan, &header, Failure::Output).await?;
        return Ok(());
    };
    let failed = |source| Failure::File {
        path: path.clone(),
        source,
    };
    let write = async |file: std::fs::File| {
        let writer = Writer {
            output: &mut Output::to(Format::Text, file),
            include,
            prints: false,
        };
        writer.write(scan, &header, failed).await
    };
    let points = match path.metadata() {
        // A pipe or a device cannot be replaced, and holds nothing to keep.
        Ok(found) if !found.is_file() => {
            let file = std::fs::File::create(&path).map_err(failed)?;
            write(file).await?
        }
        _ => atomic_file::write(&path, true, write).await?.0,
    };
    match context.output.format {
        Format::Json => context.output.json(&Written {
            point_count: points,
            revision: (&revision).into(),
        })?,
        Format::Text => {
            let path = path.display();
            context.output.text(format_args!(
                "{points} points at revision {} written to {path}",
                revision.number
            ))?;
        }
    }
    Ok(())
}

/// The default columns of CSV: `insert` reads them back.
const CSV_COLUMNS: Include = Include::none().states();

fn header(space: &Space, include: Include) -> String {
    let mut columns = vec!["id".to_owned()];
    if include.states {
        columns.extend(coordinate_names(space));
    }
    let more = [
        (include.tags, "tag"),
        (include.revisions, "revision"),
        (include.payloads, "payload"),
    ];
    columns.extend(
        more.into_iter()
            .filter(|(is_included, _)| *is_included)
            .map(|(_, name)| name.to_owned()),
    );
    columns.join(",")
}

/// Writes the points of a scan.
struct Writer<'a> {
    output: &'a mut Output,
    include: Include,
    /// True if the output is standard output.
    prints: bool,
}

impl Writer<'_> {
    /// Writes all points, and returns their number.
    async fn write(
        self,
        mut scan: Scan,
        header: &str,
        failed: impl Fn(io::Error) -> Failure,
    ) -> Result<u64, Failure> {
        let bar = progress::bar(Some(scan.point_count()), "scanning", self.prints);
        if self.output.format == Format::Text {
            self.output.text(header).map_err(&failed)?;
        }
        let uid = Arc::clone(&scan.revision().uid);
        let mut points = 0;
        while let Some(part) = scan
            .next()
            .await
            .map_err(|error| self.stopped(points, error.into()))?
        {
            for point in part.iter() {
                write_point(self.output, point, &uid, self.include).map_err(&failed)?;
            }
            points += part.len() as u64;
            bar.set_position(points);
        }
        self.output.flush().map_err(&failed)?;
        bar.finish_and_clear();
        Ok(points)
    }

    /// Adds to an error that the printed points are incomplete; a failed scan leaves no file.
    fn stopped(&self, points: u64, failure: Failure) -> Failure {
        match self.prints {
            false => failure,
            true => Failure::Stopped {
                done: format!("only {points} points were written"),
                source: Box::new(failure),
            },
        }
    }
}

fn write_point(
    output: &mut Output,
    point: Point<'_>,
    uid: &str,
    include: Include,
) -> io::Result<()> {
    if output.format == Format::Json {
        return output.json(&PointLine::of(point, uid, include));
    }
    let mut line = point.id.to_string();
    if include.states {
        line += &format!(",{}", Row(point.state));
    }
    if include.tags {
        line += &format!(",{}", point.tag);
    }
    if include.revisions {
        line += &format!(",{}", point.revision);
    }
    if let Some(payload) = point.payload {
        line += &format!(",{}", json_payload(payload));
    }
    output.text(line)
}
