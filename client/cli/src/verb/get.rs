//! `wayfold get`

use serde::Serialize;

use crate::{
    Context,
    failure::Failure,
    options::{IncludeArgs, LatestArgs, POINT_COLUMNS},
    output::{Format, JsonId, JsonRevision, Row, json_payload},
    parse,
};
use wayfold::{Include, Point};

/// Prints points by id: their states in canonical form, tags, and the revisions that stored them
#[derive(Debug, clap::Args)]
pub(crate) struct GetArgs {
    /// The index
    name: String,
    /// The points
    #[arg(value_name = "ID", required = true, value_parser = parse::id)]
    ids: Vec<u64>,
    #[command(flatten)]
    include: IncludeArgs,
    #[command(flatten)]
    latest: LatestArgs,
}

/// A point as a line of JSON.
#[derive(Serialize)]
pub(super) struct PointLine<'a> {
    id: JsonId,
    #[serde(skip_serializing_if = "Option::is_none")]
    state: Option<&'a [f64]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    tag: Option<JsonId>,
    #[serde(skip_serializing_if = "Option::is_none")]
    revision: Option<JsonRevision<'a>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    payload: Option<String>,
}

impl<'a> PointLine<'a> {
    /// The line of a point of the index with this uid.
    pub(super) fn of(point: Point<'a>, uid: &'a str, include: Include) -> PointLine<'a> {
        PointLine {
            id: JsonId(point.id),
            state: include.states.then_some(point.state),
            tag: include.tags.then_some(JsonId(point.tag)),
            revision: include
                .revisions
                .then(|| JsonRevision::new(uid, point.revision)),
            payload: point.payload.map(|payload| json_payload(payload)),
        }
    }
}

pub(crate) async fn get(args: GetArgs, context: &mut Context) -> Result<(), Failure> {
    let include = args.include.include_or(POINT_COLUMNS);
    let index = args.latest.of(context.index(&args.name).await?);
    let points = index.get(args.ids).include(include).await?;
    let output = &mut context.output;
    for point in points.iter() {
        match output.format {
            Format::Json => output.json(&PointLine::of(point, index.uid(), include))?,
            Format::Text => output.text(text(point, include))?,
        }
    }
    Ok(())
}

fn text(point: Point<'_>, include: Include) -> String {
    let mut line = point.id.to_string();
    if include.states {
        line += &format!("  state {}", Row(point.state));
    }
    if include.tags {
        line += &format!("  tag {}", point.tag);
    }
    if include.revisions {
        line += &format!("  revision {}", point.revision);
    }
    if let Some(payload) = point.payload {
        line += &format!("  payload \"{}\"", payload.escape_ascii());
    }
    line
}
