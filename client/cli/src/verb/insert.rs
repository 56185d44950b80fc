//! `wayfold insert`

use std::{ops::Range, path::PathBuf};

use clap::ArgGroup;
use serde::Serialize;

use super::neighbors::{NeighborFields, neighbor_table};
use crate::{
    Context,
    failure::{Failure, stopped},
    input::{self, Columns, Source, Table},
    options::{self, Column, RadiusArgs},
    output::{Format, JsonId, JsonIds, JsonRevision, Output},
    parse::{self, MaskedTag, RevisionArg},
    progress,
};
use wayfold::{
    Error, Include, IndexHandle, Inserted, NeighborSpec, Neighbors, Outcome, Revision,
    StateNeighbors,
};

const EXAMPLES: &str = "\
A CSV row is one state, its numbers in the order of the space (`wayfold info` names them). A header
line is optional, and names the columns for --ids and --tags; without ids the server assigns them. An
npy file holds float64 or float32, one state a row. The command checks the whole file before it sends
anything; then it sends calls of 1000 rows, fewer where a limit of the server is lower, and each call
is stored as a whole or not at all. If one fails, the command sums up what those before it stored; the
outcomes of some of them may be lost (partial_count and partial_ids in JSON).

With --knn, --radius or a factor, each row is printed with the neighbours that it had when it was
inserted: of any two inserts the later one sees the earlier one.

Examples:
  wayfold insert arm poses.csv --tag 0x1
  wayfold insert arm roadmap.csv --ids id        reads what `wayfold scan arm roadmap.csv` wrote
  sampler | wayfold insert arm - --min-separation 0.05 --knn 10 --output json
  wayfold insert arm poses.csv --k-factor 5.44 --since 42 --include states";

/// Inserts the states of a file
#[derive(Debug, clap::Args)]
#[command(
    after_help = EXAMPLES,
    group = ArgGroup::new("neighbors").multiple(true).args(["knn", "k_factor", "radius", "radius_factor"])
)]
pub(crate) struct InsertArgs {
    /// The index
    name: String,
    /// FILE.csv, FILE.npy, or - for CSV on standard input
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// The column of the CSV header that holds the ids
    #[arg(long, value_name = "COLUMN")]
    ids: Option<String>,
    /// The column of the CSV header that holds the tags
    #[arg(long, value_name = "COLUMN")]
    tags: Option<String>,
    /// The tag of all rows: decimal, or hexadecimal after 0x
    #[arg(long, value_name = "VALUE", value_parser = parse::tag, conflicts_with = "tags")]
    tag: Option<u64>,
    /// Replace different points that are stored under the ids; without it they are an error
    #[arg(long)]
    replace: bool,
    /// Leave out rows that have a point at a distance below D
    #[arg(long, value_name = "D", value_parser = parse::finite, allow_negative_numbers = true)]
    min_separation: Option<f64>,
    #[command(flatten)]
    neighbors: NeighborArgs,
}

/// The neighbours that are printed of each row.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Neighbours of each row")]
struct NeighborArgs {
    /// Print the K nearest points that each row had
    #[arg(long, value_name = "K", value_parser = clap::value_parser!(u32).range(1..))]
    knn: Option<u32>,
    /// In the place of --knn: F * ln n, rounded up, for n points
    #[arg(long, value_name = "F", value_parser = parse::finite, allow_negative_numbers = true, conflicts_with = "knn")]
    k_factor: Option<f64>,
    #[command(flatten)]
    radius: RadiusArgs,
    /// Only neighbours with this tag, or with these bits under the mask
    #[arg(long, value_name = "VALUE[/MASK]", value_parser = parse::masked_tag, requires = "neighbors")]
    neighbor_tag: Option<MaskedTag>,
    /// Only neighbours whose state a later revision stored
    #[arg(long, value_name = "NUMBER[@UID]", value_parser = parse::revision, requires = "neighbors")]
    since: Option<RevisionArg>,
    /// The columns to print of each neighbour in addition to its id and distance, separated by commas
    #[arg(
        long,
        value_enum,
        value_name = "COLUMNS",
        value_delimiter = ',',
        requires = "neighbors"
    )]
    include: Vec<Column>,
}

impl NeighborArgs {
    /// The neighbours to find, if any are wanted.
    fn spec(&self, index: &IndexHandle) -> Option<NeighborSpec> {
        let radius = self.radius.radius();
        let mut spec = match (self.knn, self.k_factor) {
            (Some(k), _) => NeighborSpec::k(k),
            (None, Some(factor)) => NeighborSpec::k_factor(factor),
            (None, None) => NeighborSpec::within(radius?),
        };
        if let Some(radius) = radius {
            spec = spec.radius(radius);
        }
        let filter = options::filter(self.neighbor_tag, self.since.as_ref(), index);
        Some(spec.filter(filter).include(self.include()))
    }

    fn include(&self) -> Include {
        options::include(&self.include)
    }
}

/// The rows of a call: enough to be fast, and few enough not to delay other callers or exceed a deadline.
const CALL_ROWS: usize = 1000;

pub(crate) async fn insert(args: InsertArgs, context: &mut Context) -> Result<(), Failure> {
    let index = context.index(&args.name).await?;
    let table = input::table(
        &Source::file(&args.file),
        index.space(),
        Columns {
            ids: args.ids.as_deref(),
            tags: args.tags.as_deref(),
        },
    )?;
    let rows = table.states.len();
    let spec = args.neighbors.spec(&index);
    let bar = progress::bar(Some(rows as u64), "inserting", spec.is_some());
    let mut summary = Summary::default();
    let mut is_read = true;
    for start in (0..rows).step_by(CALL_ROWS) {
        let end = rows.min(start + CALL_ROWS);
        let inserted = match send(&index, &args, spec.clone(), &table, start..end).await {
            Ok(inserted) => inserted,
            Err(failure) => {
                summary.add_partial(&failure);
                if start > 0 || summary.partial_count > 0 {
                    // The refusal says more than an output that is closed.
                    let _ = summary.print(&index.revision(), &mut context.output);
                }
                return Err(stopped(start..end, rows, failure));
            }
        };
        if let (Some(neighbors), true) = (&inserted.neighbors, is_read) {
            let given = table.ids.get(start..end).unwrap_or_default();
            match print_rows(
                &mut context.output,
                start,
                &inserted.outcomes,
                given,
                neighbors,
                args.neighbors.include(),
            ) {
                // A closed pipe ends the output, not the insert.
                Err(failure) if failure.is_broken_pipe() => is_read = false,
                printed => printed.map_err(|failure| stopped(end..end, rows, failure))?,
            }
        }
        summary.add(&inserted);
        bar.set_position(end as u64);
    }
    bar.finish_and_clear();
    // The handle knows the revision of the last call.
    summary.print(&index.revision(), &mut context.output)
}

async fn send(
    index: &IndexHandle,
    args: &InsertArgs,
    spec: Option<NeighborSpec>,
    table: &Table,
    rows: Range<usize>,
) -> Result<Inserted, Failure> {
    let ids = table.ids.get(rows.clone()).unwrap_or_default();
    let tags = match args.tag {
        Some(tag) => vec![tag; rows.len()],
        None => table.tags.get(rows.clone()).unwrap_or_default().to_vec(),
    };
    let states = rows.map(|row| table.states.row(row));
    let mut insert = index.insert(states).ids(ids).tags(tags);
    if args.replace {
        insert = insert.replace();
    }
    if let Some(distance) = args.min_separation {
        insert = insert.min_separation(distance);
    }
    if let Some(spec) = spec {
        insert = insert.neighbors(spec);
    }
    Ok(insert.await?)
}

#[derive(Serialize)]
struct RowLine<'a> {
    /// Null for a row that was left out and had no given id.
    id: Option<JsonId>,
    outcome: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    blocker: Option<JsonId>,
    #[serde(flatten)]
    neighbors: NeighborFields<'a>,
}

/// Prints the rows of one call; its first row is row `start` of the file, counted from 0.
fn print_rows(
    output: &mut Output,
    start: usize,
    outcomes: &[Outcome],
    given: &[u64],
    neighbors: &Neighbors,
    include: Include,
) -> Result<(), Failure> {
    for (i, outcome) in outcomes.iter().enumerate() {
        let given = given.get(i).copied();
        let id = outcome.id().or(given);
        let row = neighbors.row(i);
        print_row(output, start + i + 1, id, *outcome, row, include)?;
    }
    Ok(output.flush()?)
}

fn print_row(
    output: &mut Output,
    number: usize,
    id: Option<u64>,
    outcome: Outcome,
    row: StateNeighbors<'_>,
    include: Include,
) -> Result<(), Failure> {
    let (name, text, blocker) = match outcome {
        Outcome::Inserted { .. } => ("INSERTED", "inserted", None),
        Outcome::Unchanged { .. } => ("UNCHANGED", "unchanged", None),
        Outcome::Replaced { .. } => ("REPLACED", "replaced", None),
        Outcome::TooClose { blocker } => ("TOO_CLOSE", "too close", Some(blocker)),
    };
    if output.format == Format::Json {
        output.json(&RowLine {
            id: id.map(JsonId),
            outcome: name,
            blocker: blocker.map(JsonId),
            neighbors: NeighborFields::of(row, include),
        })?;
        return Ok(());
    }
    let id = id.map(|id| format!(", id {id}")).unwrap_or_default();
    let to = blocker
        .map(|blocker| format!(" to id {blocker}"))
        .unwrap_or_default();
    output.text(format_args!(
        "row {number}: {text}{to}{id}, {} nearest",
        row.len()
    ))?;
    neighbor_table(output, row, include)?;
    Ok(())
}

/// The outcomes of all calls together.
#[derive(Default)]
struct Summary {
    inserted: u64,
    unchanged: u64,
    replaced: u64,
    too_close: u64,
    first_id: Option<JsonId>,
    last_id: Option<JsonId>,
    /// The rows that took effect in the call that failed, and the ids of those that are stored.
    partial_count: usize,
    partial_ids: Vec<u64>,
}

#[derive(Serialize)]
struct SummaryLine<'a> {
    inserted_count: u64,
    unchanged_count: u64,
    replaced_count: u64,
    too_close_count: u64,
    /// The ids of the first and the last stored row; null if no row is stored.
    first_id: Option<JsonId>,
    last_id: Option<JsonId>,
    /// The rows that took effect in a call that failed, and the ids of those that are stored. Their outcomes are lost.
    #[serde(skip_serializing_if = "Option::is_none")]
    partial_count: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    partial_ids: Option<JsonIds<'a>>,
    revision: JsonRevision<'a>,
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
            self.add_id(outcome.id());
        }
    }

    fn add_id(&mut self, id: Option<u64>) {
        let id = id.map(JsonId);
        self.first_id = self.first_id.or(id);
        self.last_id = id.or(self.last_id);
    }

    /// Adds the rows of a failed call that took effect before its error.
    fn add_partial(&mut self, failure: &Failure) {
        if let Failure::Client(Error::Partial { done, ids, .. }) = failure {
            ids.iter().for_each(|id| self.add_id(Some(*id)));
            (self.partial_count, self.partial_ids) = (*done, ids.clone());
        }
    }

    fn print(&self, revision: &Revision, output: &mut Output) -> Result<(), Failure> {
        let Summary {
            inserted,
            unchanged,
            replaced,
            too_close,
            first_id,
            last_id,
            partial_count,
            ref partial_ids,
        } = *self;
        let is_partial = partial_count > 0;
        if output.format == Format::Json {
            return Ok(output.json(&SummaryLine {
                inserted_count: inserted,
                unchanged_count: unchanged,
                replaced_count: replaced,
                too_close_count: too_close,
                first_id,
                last_id,
                partial_count: is_partial.then_some(partial_count),
                partial_ids: is_partial.then_some(JsonIds(partial_ids)),
                revision: revision.into(),
            })?);
        }
        let ids = match (first_id, last_id) {
            (Some(JsonId(first)), Some(JsonId(last))) => {
                format!("; first id {first}, last id {last}")
            }
            _ => String::new(),
        };
        let partial = match is_partial {
            true => format!(", {partial_count} more by the call that failed"),
            false => String::new(),
        };
        output.text(format_args!(
            "inserted {inserted}, unchanged {unchanged}, replaced {replaced}, too close {too_close}{partial}{ids}; \
             revision {}",
            revision.number
        ))?;
        Ok(())
    }
}
