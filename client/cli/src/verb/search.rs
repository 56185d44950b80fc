//! `wayfold knn` and `wayfold query`

use std::path::PathBuf;

use futures_util::{StreamExt, future::BoxFuture};
use serde::Serialize;
use tokio_stream::wrappers::ReceiverStream;

use crate::{
    Session,
    failure::Failure,
    input::{self, InputError, Row, Source},
    output::{Format, JsonIds, Output, neighbor_table},
    parse, progress,
};
use wayfold::{Error, IndexHandle, Neighbors, States};

const KNN_EXAMPLES: &str = "\
Examples:
  wayfold knn arm -k 10 --state 0.1,0.2,0.3,0,0,0,1
  wayfold knn arm poses.npy -k 1 --output json | jq '.ids[0]'
  wayfold knn arm roadmap.csv --ids id -k 11      a scan's rows, asked about

In JSON each state has a line {\"ids\":[...],\"distances\":[...],\"revision\":N}. A file is
read as it is answered: neither its rows nor the answers are held.";

const QUERY_EXAMPLES: &str = "\
Examples:
  wayfold query arm --radius 0.5 --state 0.1,0.2,0.3,0,0,0,1
  sampler | wayfold query arm - --radius 0.5 --output json

In JSON each state has a line {\"ids\":[...],\"distances\":[...],\"revision\":N}. A file is
read as it is answered: neither its rows nor the answers are held.";

/// The states that are asked about: one of the two.
#[derive(Debug, clap::Args)]
#[group(required = true, multiple = false)]
struct Given {
    /// FILE.csv, FILE.npy, or - for CSV on standard input: a row a state
    #[arg(value_name = "FILE")]
    file: Option<PathBuf>,
    /// One state, its numbers with commas between
    #[arg(long, value_name = "NUMBERS", allow_hyphen_values = true)]
    state: Option<String>,
}

/// What both verbs have.
#[derive(Debug, clap::Args)]
struct Asked {
    #[command(flatten)]
    given: Given,
    /// A column of the CSV header that holds ids, which are no coordinates
    #[arg(long, value_name = "COLUMN", conflicts_with = "state")]
    ids: Option<String>,
    /// Allow answers that are farther than the true ones by a factor of 1 + E
    #[arg(long, value_name = "E", value_parser = parse::finite, allow_negative_numbers = true, default_value = "0")]
    epsilon: f64,
}

/// Prints the k nearest points of each state, nearest first
#[derive(Debug, clap::Args)]
#[command(
    after_help = KNN_EXAMPLES,
    override_usage = "wayfold knn [OPTIONS] -k <K> <NAME> <FILE | --state <NUMBERS>>"
)]
pub(crate) struct KnnArgs {
    /// The index
    name: String,
    #[command(flatten)]
    asked: Asked,
    /// How many
    #[arg(short, value_parser = clap::value_parser!(u32).range(1..))]
    k: u32,
    /// Only points at this distance or nearer
    #[arg(long, value_name = "R", value_parser = parse::distance, allow_negative_numbers = true)]
    radius: Option<f64>,
}

/// Prints all points within a radius of each state, nearest first
#[derive(Debug, clap::Args)]
#[command(
    after_help = QUERY_EXAMPLES,
    override_usage = "wayfold query [OPTIONS] --radius <R> <NAME> <FILE | --state <NUMBERS>>"
)]
pub(crate) struct QueryArgs {
    /// The index
    name: String,
    #[command(flatten)]
    asked: Asked,
    /// The distance up to which points count, itself included
    #[arg(long, value_name = "R", value_parser = parse::distance, allow_negative_numbers = true)]
    radius: f64,
}

pub(crate) async fn knn(args: KnnArgs, session: &mut Session) -> Result<(), Failure> {
    let epsilon = args.asked.epsilon;
    search(&args.name, &args.asked, session, |index, states| {
        let knn = index.knn(states).k(args.k).epsilon(epsilon);
        match args.radius {
            Some(radius) => knn.radius(radius),
            None => knn,
        }
        .into_future()
    })
    .await
}

pub(crate) async fn query(args: QueryArgs, session: &mut Session) -> Result<(), Failure> {
    let epsilon = args.asked.epsilon;
    search(&args.name, &args.asked, session, |index, states| {
        index
            .query(states, args.radius)
            .epsilon(epsilon)
            .into_future()
    })
    .await
}

/// States a call: as many as are there, up to this.
const CALL_ROWS: usize = 250;

/// Calls under way at once. Their answers are printed in the order of the states.
const CALLS: usize = 4;

type Answer = BoxFuture<'static, Result<Neighbors, Error>>;

async fn search(
    name: &str,
    asked: &Asked,
    session: &mut Session,
    ask: impl Fn(&IndexHandle, &States) -> Answer,
) -> Result<(), Failure> {
    let index = session.index(name).await?;
    let source = match (&asked.given.state, &asked.given.file) {
        (Some(state), _) => Source::Literal(state.clone()),
        (None, Some(file)) => Source::file(file),
        // One of the two is required.
        (None, None) => Source::Stdin,
    };
    let rows = input::rows(&source, index.space(), asked.ids.as_deref())?;
    let rows = ReceiverStream::new(input::spawn(rows, CALL_ROWS * CALLS));
    let width = index.coordinates();
    let mut answers = rows
        .ready_chunks(CALL_ROWS)
        .map(|rows| {
            let (states, wrong) = split(rows, width);
            let answer = (!states.is_empty()).then(|| ask(&index, &states));
            async move {
                let answer = match answer {
                    Some(answer) => Some(answer.await),
                    None => None,
                };
                (answer, wrong)
            }
        })
        .buffered(CALLS);
    let bar = progress::bar(None, "asking", true);
    let mut number = 0;
    while let Some((answer, wrong)) = answers.next().await {
        if let Some(answer) = answer {
            let neighbors = answer?;
            for i in 0..neighbors.len() {
                number += 1;
                print(&mut session.output, number, &neighbors, i)?;
            }
            session.output.flush()?;
            bar.inc(neighbors.len() as u64);
        }
        if let Some(wrong) = wrong {
            return Err(wrong.into());
        }
    }
    bar.finish_and_clear();
    Ok(())
}

/// The states up to the first row that is wrong, and what is wrong with it.
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
    ids: JsonIds<'a>,
    distances: &'a [f64],
    revision: u64,
}

fn print(
    output: &mut Output,
    number: usize,
    neighbors: &Neighbors,
    i: usize,
) -> Result<(), Failure> {
    let (row, revision) = (neighbors.row(i), neighbors.revision_of(i).number);
    if output.format == Format::Json {
        output.json(&NeighborsLine {
            ids: JsonIds(row.ids),
            distances: row.distances,
            revision,
        })?;
        return Ok(());
    }
    let plural = if row.len() == 1 { "point" } else { "points" };
    output.text(format_args!(
        "state {number}: {} {plural} at revision {revision}",
        row.len()
    ))?;
    neighbor_table(output, row.ids, row.distances)?;
    Ok(())
}
