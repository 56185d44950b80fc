//! The neighbours of one state: as fields of a JSON line, and as a table.

use std::io;

use serde::Serialize;
use wayfold::{Include, StateNeighbors};

use crate::output::{Column, JsonId, JsonIds, Output, Row as Numbers, json_payload, table};

/// The fields of a JSON line: ids and distances, and the included columns.
#[derive(Serialize)]
pub(super) struct NeighborFields<'a> {
    ids: Vec<JsonId>,
    distances: Vec<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    states: Option<Vec<&'a [f64]>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    tags: Option<JsonIds<'a>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    revisions: Option<&'a [u64]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    payloads: Option<Vec<String>>,
}

impl<'a> NeighborFields<'a> {
    pub(super) fn of(row: StateNeighbors<'a>, include: Include) -> NeighborFields<'a> {
        let payloads = row
            .payloads()
            .map(|payloads| payloads.iter().map(|payload| json_payload(payload)));
        NeighborFields {
            ids: row.ids().map(JsonId).collect(),
            distances: row.distances().collect(),
            states: include.states.then(|| states(row).collect()),
            tags: row.tags().map(JsonIds),
            revisions: row.revisions(),
            payloads: payloads.map(Iterator::collect),
        }
    }
}

fn states<'a>(row: StateNeighbors<'a>) -> impl Iterator<Item = &'a [f64]> {
    (0..row.len()).map(move |i| row.state(i).unwrap_or_default())
}

/// Prints one line a neighbour below a header; nothing if there are none.
pub(super) fn neighbor_table(
    output: &mut Output,
    row: StateNeighbors<'_>,
    include: Include,
) -> io::Result<()> {
    if row.is_empty() {
        return Ok(());
    }
    let distances = row.distances().map(|distance| format!("{distance:?}"));
    let mut columns = vec![
        Column::new("id", true, row.ids()),
        Column::new("distance", false, distances),
    ];
    if let Some(tags) = row.tags() {
        columns.push(Column::new("tag", true, tags));
    }
    if let Some(revisions) = row.revisions() {
        columns.push(Column::new("revision", true, revisions));
    }
    if include.states {
        columns.push(Column::new("state", false, states(row).map(Numbers)));
    }
    if let Some(payloads) = row.payloads() {
        let payloads = payloads.iter().map(|payload| payload.escape_ascii());
        columns.push(Column::new("payload", false, payloads));
    }
    table(output, "  ", &columns)
}
