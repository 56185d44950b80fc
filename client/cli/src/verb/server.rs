//! `wayfold server`

use indicatif::HumanBytes;
use serde::Serialize;

use crate::{Context, failure::Failure, output::Format};
use wayfold::{Durability, ServerInfo};

#[derive(Serialize)]
struct ServerLine<'a> {
    server: &'a str,
    version: &'a str,
    durability: &'a str,
    limits: LimitsLine,
}

#[derive(Serialize)]
struct LimitsLine {
    max_rows_per_call: usize,
    max_ids_per_call: usize,
    max_k: u64,
    max_request_bytes: usize,
    max_answer_bytes: usize,
    max_payload_bytes: usize,
    max_indexes: u64,
    max_reserved_ids: u64,
}

/// The name of the setting `data.durability`, and the failures that a write survives.
pub(crate) fn durability_words(durability: Durability) -> (&'static str, &'static str) {
    match durability {
        Durability::Memory => ("memory", "nothing: there is no data directory"),
        Durability::None => ("none", "an orderly stop of the server"),
        Durability::Os => ("os", "the end of the server, whatever ends it"),
        Durability::Fsync => ("fsync", "a loss of power"),
        _ => ("unknown", "this client does not know"),
    }
}

pub(crate) async fn server(context: &mut Context) -> Result<(), Failure> {
    let ServerInfo {
        version,
        durability,
        limits,
        ..
    } = context.client.server().await?;
    let (server, output) = (context.client.uri(), &mut context.output);
    let (durability, survives) = durability_words(durability);
    if output.format == Format::Json {
        return Ok(output.json(&ServerLine {
            server,
            version: &version,
            durability,
            limits: LimitsLine {
                max_rows_per_call: limits.max_rows_per_call,
                max_ids_per_call: limits.max_ids_per_call,
                max_k: limits.max_k,
                max_request_bytes: limits.max_request_bytes,
                max_answer_bytes: limits.max_answer_bytes,
                max_payload_bytes: limits.max_payload_bytes,
                max_indexes: limits.max_indexes,
                max_reserved_ids: limits.max_reserved_ids,
            },
        })?);
    }
    let bytes = |bytes: usize| HumanBytes(bytes as u64);
    output.text(format_args!("server      {server}"))?;
    output.text(format_args!("version     {version}"))?;
    output.text(format_args!(
        "durability  {durability}; a write survives {survives}"
    ))?;
    output.text(format_args!(
        "a call      {} states or {} ids, {} in, {} out",
        limits.max_rows_per_call,
        limits.max_ids_per_call,
        bytes(limits.max_request_bytes),
        bytes(limits.max_answer_bytes)
    ))?;
    output.text(format_args!("k           {}", limits.max_k))?;
    output.text(format_args!(
        "a payload   {}",
        bytes(limits.max_payload_bytes)
    ))?;
    output.text(format_args!("indices     {}", limits.max_indexes))?;
    output.text(format_args!(
        "a session   {} ids at once",
        limits.max_reserved_ids
    ))?;
    Ok(())
}
