//! `wayfold get`

use serde::Serialize;

use crate::{
    Session,
    failure::Failure,
    output::{Format, JsonId, Row},
    parse,
};
use wayfold::Point;

/// Prints points: their states in canonical form, tags, and the revisions that stored them
#[derive(Debug, clap::Args)]
pub(crate) struct GetArgs {
    /// The index
    name: String,
    /// The points
    #[arg(value_name = "ID", required = true, value_parser = parse::id)]
    ids: Vec<u64>,
}

/// A point as a line of JSON.
#[derive(Serialize)]
pub(super) struct PointLine<'a> {
    id: JsonId,
    state: &'a [f64],
    tag: JsonId,
    revision: u64,
}

impl PointLine<'_> {
    pub(super) fn of(point: Point<'_>) -> PointLine<'_> {
        PointLine {
            id: JsonId(point.id),
            state: point.state,
            tag: JsonId(point.tag),
            revision: point.revision,
        }
    }
}

pub(crate) async fn get(args: GetArgs, session: &mut Session) -> Result<(), Failure> {
    let points = session.index(&args.name).await?.get(args.ids).await?;
    let output = &mut session.output;
    for point in points.iter() {
        match output.format {
            Format::Json => output.json(&PointLine::of(point))?,
            Format::Text => {
                let state = Row(point.state);
                output.text(format_args!(
                    "{}  state {state}  tag {}  revision {}",
                    point.id, point.tag, point.revision
                ))?;
            }
        }
    }
    Ok(())
}
