//! `wayfold insert`

use std::path::PathBuf;

use serde::Serialize;

use crate::{
    Session,
    failure::Failure,
    input::{self, Source, Table},
    output::{Format, JsonId, JsonIds, Output, neighbor_table},
    parse, progress,
};
use wayfold::{IndexHandle, Inserted, NeighborSpec, Neighbors, Outcome, Row};

const EXAMPLES: &str = "\
A CSV row is one state, its numbers in the order of the space (`wayfold info` names them). A header
line is allowed, and needed to name a column of ids; without ids the server assigns them. An npy
file holds float64 or float32, a row a state. The whole file is checked before anything is sent;
then it is sent in calls of 1000 rows, each of which is stored as a whole or not at all.

Examples:
  wayfold insert arm poses.csv
  wayfold insert arm roadmap.csv --ids id        what `wayfold scan arm roadmap.csv` wrote
  sampler | wayfold insert arm - --min-separation 0.05 --knn 10 --output json";

/// Inserts the states of a file
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct InsertArgs {
    /// The index
    name: String,
    /// FILE.csv, FILE.npy, or - for CSV on standard input
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// The column of the CSV header that holds the ids
    #[arg(long, value_name = "COLUMN")]
    ids: Option<String>,
    /// Replace points that are stored under one of the ids, where another point there is an error otherwise
    #[arg(long)]
    replace: bool,
    /// Print the K nearest points that each row had when it was inserted
    #[arg(long, value_name = "K", value_parser = clap::value_parser!(u32).range(1..))]
    knn: Option<u32>,
    /// Leave out rows that have a point at a distance below D
    #[arg(long, value_name = "D", value_parser = parse::finite, allow_negative_numbers = true)]
    min_separation: Option<f64>,
}

/// Rows a call: enough to be fast, and few enough not to hold up others or a deadline.
const CALL_ROWS: usize = 1000;

pub(crate) async fn insert(args: InsertArgs, session: &mut Session) -> Result<(), Failure> {
    let index = session.index(&args.name).await?;
    let table = input::table(
        &Source::file(&args.file),
        index.space(),
        args.ids.as_deref(),
    )?;
    let rows = table.states.len();
    let bar = progress::bar(Some(rows as u64), "inserting", args.knn.is_some());
    let mut summary = Summary {
        revision: index.revision().number,
        ..Summary::default()
    };
    let mut is_read = true;
    for start in (0..rows).step_by(CALL_ROWS) {
        let end = rows.min(start + CALL_ROWS);
        let inserted = send(&index, &args, &table, start..end).await;
        let inserted = inserted.map_err(|failure| stopped(start, rows, failure))?;
        if let (Some(neighbors), true) = (&inserted.neighbors, is_read) {
            let given = table.ids.get(start..end).unwrap_or_default();
            match print_rows(
                &mut session.output,
                start,
                &inserted.outcomes,
                given,
                neighbors,
            ) {
                // Who stops reading has not asked to stop inserting.
                Err(failure) if failure.is_broken_pipe() => is_read = false,
                printed => printed?,
            }
        }
        summary.add(&inserted);
        bar.set_position(end as u64);
    }
    bar.finish_and_clear();
    summary.print(&mut session.output)
}

async fn send(
    index: &IndexHandle,
    args: &InsertArgs,
    table: &Table,
    rows: std::ops::Range<usize>,
) -> Result<Inserted, Failure> {
    let ids = table.ids.get(rows.clone()).unwrap_or_default();
    let mut insert = index.insert(rows.map(|row| table.states.row(row))).ids(ids);
    if args.replace {
        insert = insert.replace();
    }
    if let Some(distance) = args.min_separation {
        insert = insert.min_separation(distance);
    }
    if let Some(k) = args.knn {
        insert = insert.neighbors(NeighborSpec::k(k));
    }
    Ok(insert.await?)
}

/// Says how many rows the calls before the failed one have inserted.
fn stopped(done: usize, rows: usize, failure: Failure) -> Failure {
    match done {
        0 => failure,
        _ => Failure::Stopped {
            done: format!("the first {done} of {rows} rows took effect"),
            source: Box::new(failure),
        },
    }
}

#[derive(Serialize)]
struct RowLine<'a> {
    /// Null for a row that was left out before it was assigned one.
    id: Option<JsonId>,
    outcome: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    blocker: Option<JsonId>,
    ids: JsonIds<'a>,
    distances: &'a [f64],
}

/// Prints the rows of one call, the first of which is row `start` of the file.
fn print_rows(
    output: &mut Output,
    start: usize,
    outcomes: &[Outcome],
    given: &[u64],
    neighbors: &Neighbors,
) -> Result<(), Failure> {
    for (i, outcome) in outcomes.iter().enumerate() {
        let given = given.get(i).copied();
        print_row(output, start + i + 1, *outcome, given, neighbors.row(i))?;
    }
    Ok(output.flush()?)
}

fn print_row(
    output: &mut Output,
    number: usize,
    outcome: Outcome,
    given: Option<u64>,
    near: Row<'_>,
) -> Result<(), Failure> {
    let (name, said, blocker) = match outcome {
        Outcome::Inserted { .. } => ("INSERTED", "inserted", None),
        Outcome::Unchanged { .. } => ("UNCHANGED", "unchanged", None),
        Outcome::Replaced { .. } => ("REPLACED", "replaced", None),
        Outcome::TooClose { blocker } => ("TOO_CLOSE", "too close", Some(blocker)),
    };
    let id = outcome.id().or(given);
    if output.format == Format::Json {
        output.json(&RowLine {
            id: id.map(JsonId),
            outcome: name,
            blocker: blocker.map(JsonId),
            ids: JsonIds(near.ids),
            distances: near.distances,
        })?;
        return Ok(());
    }
    let id = id.map(|id| format!(", id {id}")).unwrap_or_default();
    let to = blocker
        .map(|blocker| format!(" to id {blocker}"))
        .unwrap_or_default();
    output.text(format_args!(
        "row {number}: {said}{to}{id}, {} nearest",
        near.len()
    ))?;
    neighbor_table(output, near.ids, near.distances)?;
    Ok(())
}

#[derive(Default, Serialize)]
struct Summary {
    inserted: u64,
    unchanged: u64,
    replaced: u64,
    too_close: u64,
    /// The ids of the first and the last row that is stored; null if none is.
    first_id: Option<JsonId>,
    last_id: Option<JsonId>,
    revision: u64,
}

impl Summary {
    fn add(&mut self, done: &Inserted) {
        for outcome in &done.outcomes {
            let count = match outcome {
                Outcome::Inserted { .. } => &mut self.inserted,
                Outcome::Unchanged { .. } => &mut self.unchanged,
                Outcome::Replaced { .. } => &mut self.replaced,
                Outcome::TooClose { .. } => &mut self.too_close,
            };
            *count += 1;
            let id = outcome.id().map(JsonId);
            self.first_id = self.first_id.or(id);
            self.last_id = id.or(self.last_id);
        }
        self.revision = done.revision.number;
    }

    fn print(&self, output: &mut Output) -> Result<(), Failure> {
        if output.format == Format::Json {
            return Ok(output.json(self)?);
        }
        let ids = match (self.first_id, self.last_id) {
            (Some(JsonId(first)), Some(JsonId(last))) => {
                format!("; first id {first}, last id {last}")
            }
            _ => String::new(),
        };
        let Summary {
            inserted,
            unchanged,
            replaced,
            too_close,
            revision,
            ..
        } = self;
        output.text(format_args!(
            "inserted {inserted}, unchanged {unchanged}, replaced {replaced}, too close {too_close}{ids}; \
             revision {revision}"
        ))?;
        Ok(())
    }
}
