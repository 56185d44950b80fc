//! `wayfold knn` and `wayfold query`

use std::path::PathBuf;

use clap::ArgGroup;
use futures_util::{StreamExt, future::BoxFuture};
use serde::Serialize;
use tokio_stream::wrappers::ReceiverStream;

use super::neighbors::{NeighborFields, neighbor_table};
use crate::{
    Context,
    failure::Failure,
    input::{self, Columns, InputError, Row, Source},
    options::{FilterArgs, IncludeArgs, LatestArgs, RadiusArgs},
    output::{Format, JsonRevision, Output},
    parse, progress,
};
use wayfold::{Error, Include, IndexHandle, Neighbors, Radius, States};

const KNN_EXAMPLES: &str = "\
Examples:
  wayfold knn arm -k 10 --state 0.1,0.2,0.3,0,0,0,1
  wayfold knn arm poses.npy -k 1 --output json | jq '.ids[0]'
  wayfold knn arm roadmap.csv --ids id -k 11      the neighbours of a scan's own points
  wayfold knn arm poses.npy --k-factor 5.44       as many as k-nearest PRM* connects
  wayfold knn arm poses.npy -k 5 --tag 0x1/0xff --include tags,states

In JSON each state has a line {\"ids\":[...],\"distances\":[...],\"revision\":{\"uid\":...,\"number\":N}},
and a list for each column of --include. The command answers a file while it reads it, and holds
neither the rows nor the answers in memory.";

const QUERY_EXAMPLES: &str = "\
Examples:
  wayfold query arm --radius 0.5 --state 0.1,0.2,0.3,0,0,0,1
  sampler | wayfold query arm - --radius 0.5 --output json
  wayfold query arm poses.npy --radius-factor 2 --radius-max 0.5     the radius of PRM* and RRT*

In JSON each state has a line {\"ids\":[...],\"distances\":[...],\"revision\":{\"uid\":...,\"number\":N}},
and a list for each column of --include. The command answers a file while it reads it, and holds
neither the rows nor the answers in memory.";

/// The states to search around: one of the two is given.
#[derive(Debug, clap::Args)]
#[group(required = true, multiple = false)]
struct StatesArgs {
    /// FILE.csv, FILE.npy, or - for CSV on standard input: one state a row
    #[arg(value_name = "FILE")]
    file: Option<PathBuf>,
    /// One state, its numbers separated by commas
    #[arg(long, value_name = "NUMBERS", allow_hyphen_values = true)]
    state: Option<String>,
}

/// The arguments that both verbs have.
#[derive(Debug, clap::Args)]
struct SearchArgs {
    /// The index
    name: String,
    #[command(flatten)]
    states: StatesArgs,
    /// The column of the CSV header that holds ids, which are not part of the states
    #[arg(long, value_name = "COLUMN", conflicts_with = "state")]
    ids: Option<String>,
    /// The column of the CSV header that holds tags, which are not part of the states
    #[arg(long, value_name = "COLUMN", conflicts_with = "state")]
    tags: Option<String>,
    #[command(flatten)]
    radius: RadiusArgs,
    /// Allow answers that are farther than the true ones by a factor of 1 + E
    #[arg(long, value_name = "E", value_parser = parse::finite, allow_negative_numbers = true, default_value = "0")]
    epsilon: f64,
    #[command(flatten)]
    filter: FilterArgs,
    #[command(flatten)]
    include: IncludeArgs,
    #[command(flatten)]
    latest: LatestArgs,
}

impl SearchArgs {
    fn columns(&self) -> Columns<'_> {
        Columns {
            ids: self.ids.as_deref(),
            tags: self.tags.as_deref(),
        }
    }

    fn include(&self) -> Include {
        self.include.include_or(Include::default())
    }
}

/// Prints the k nearest points of each state, nearest first
#[derive(Debug, clap::Args)]
#[command(
    after_help = KNN_EXAMPLES,
    override_usage = "wayfold knn [OPTIONS] <-k <K> | --k-factor <F>> <NAME> <FILE | --state <NUMBERS>>",
    group = ArgGroup::new("k_form").required(true).args(["k", "k_factor"])
)]
pub(crate) struct KnnArgs {
    #[command(flatten)]
    search: SearchArgs,
    /// The greatest number of neighbours of a state
    #[arg(short, value_parser = clap::value_parser!(u32).range(1..))]
    k: Option<u32>,
    /// In the place of -k: F * ln n, rounded up, for n points
    #[arg(long, value_name = "F", value_parser = parse::finite, allow_negative_numbers = true)]
    k_factor: Option<f64>,
}

/// Prints all points within a radius of each state, nearest first
#[derive(Debug, clap::Args)]
#[command(
    after_help = QUERY_EXAMPLES,
    override_usage = "wayfold query [OPTIONS] <--radius <R> | --radius-factor <F>> <NAME> <FILE | --state <NUMBERS>>",
    group = ArgGroup::new("radius_form").required(true).args(["radius", "radius_factor"])
)]
pub(crate) struct QueryArgs {
    #[command(flatten)]
    search: SearchArgs,
}

pub(crate) async fn knn(args: KnnArgs, context: &mut Context) -> Result<(), Failure> {
    let (k, k_factor, search) = (args.k, args.k_factor, &args.search);
    run(search, context, |index, states| {
        let mut knn = index
            .knn(states)
            .epsilon(search.epsilon)
            .filter(search.filter.filter(index))
            .include(search.include());
        if let Some(k) = k {
            knn = knn.k(k);
        }
        if let Some(factor) = k_factor {
            knn = knn.k_factor(factor);
        }
        if let Some(radius) = search.radius.radius() {
            knn = knn.radius(radius);
        }
        knn.into_future()
    })
    .await
}

pub(crate) async fn query(args: QueryArgs, context: &mut Context) -> Result<(), Failure> {
    let search = &args.search;
    // The arguments require a radius.
    let radius = search.radius.radius();
    let radius = radius.unwrap_or(Radius::Fixed(f64::INFINITY));
    run(search, context, |index, states| {
        index
            .query(states, radius)
            .epsilon(search.epsilon)
            .filter(search.filter.filter(index))
            .include(search.include())
            .into_future()
    })
    .await
}

/// The most states of a call; it takes those that wait.
const CALL_ROWS: usize = 250;

/// Concurrent calls. Their answers are printed in the order of the states.
const CALLS: usize = 4;

type Answer = BoxFuture<'static, Result<Neighbors, Error>>;

async fn run(
    args: &SearchArgs,
    context: &mut Context,
    request: impl Fn(&IndexHandle, &States) -> Answer,
) -> Result<(), Failure> {
    let index = args.latest.of(context.index(&args.name).await?);
    let source = match (&args.states.state, &args.states.file) {
        (Some(state), _) => Source::Literal(state.clone()),
        (None, Some(file)) => Source::file(file),
        // The arguments require one of the two.
        (None, None) => Source::Stdin,
    };
    let rows = input::rows(&source, index.space(), args.columns())?;
    let rows = ReceiverStream::new(input::spawn(rows, CALL_ROWS * CALLS));
    let width = index.coordinates();
    let mut answers = rows
        .ready_chunks(CALL_ROWS)
        .map(|rows| {
            let (states, wrong) = split(rows, width);
            let answer = (!states.is_empty()).then(|| request(&index, &states));
            async move {
                let answer = match answer {
                    Some(answer) => Some(answer.await),
                    None => None,
                };
                (answer, wrong)
            }
        })
        .buffered(CALLS);
    let bar = progress::bar(None, "searching", true);
    let mut number = 0;
    while let Some((answer, wrong)) = answers.next().await {
        if let Some(answer) = answer {
            let neighbors = answer.map_err(|error| args.filter.failure(&index, error))?;
            for i in 0..neighbors.len() {
                number += 1;
                print(&mut context.output, number, &neighbors, i, args.include())?;
            }
            context.output.flush()?;
            bar.inc(neighbors.len() as u64);
        }
        if let Some(wrong) = wrong {
            return Err(wrong.into());
        }
    }
    bar.finish_and_clear();
    Ok(())
}

/// The states before the first wrong row, and the error of that row.
fn split(rows: Vec<Result<Row, InputError>>, width: usize) -> (States, Option<InputError>) {
    let mut states = States::new(width);
    for row in rows {
        let pushed = row.and_then(|row| Ok(states.push(row.state)?));
        if let Err(wrong) = pushed {
            return (states, Some(wrong));
        }
    }
    (states, None)
}

#[derive(Serialize)]
struct NeighborsLine<'a> {
    #[serde(flatten)]
    neighbors: NeighborFields<'a>,
    revision: JsonRevision<'a>,
}

fn print(
    output: &mut Output,
    number: usize,
    neighbors: &Neighbors,
    i: usize,
    include: Include,
) -> Result<(), Failure> {
    let (row, revision) = (neighbors.row(i), neighbors.revision_of(i));
    if output.format == Format::Json {
        output.json(&NeighborsLine {
            neighbors: NeighborFields::of(row, include),
            revision: (&revision).into(),
        })?;
        return Ok(());
    }
    let plural = if row.len() == 1 { "point" } else { "points" };
    output.text(format_args!(
        "state {number}: {} {plural} at revision {}",
        row.len(),
        revision.number
    ))?;
    neighbor_table(output, row, include)?;
    Ok(())
}
