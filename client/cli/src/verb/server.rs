//! `wayfold server`

use indicatif::HumanBytes;
use serde::Serialize;

use crate::{Session, failure::Failure, output::Format};
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
    rows_per_call: usize,
    ids_per_call: usize,
    k: u64,
    request_bytes: usize,
    answer_bytes: usize,
    payload_bytes: usize,
    indexes: u64,
}

pub(crate) async fn server(session: &mut Session) -> Result<(), Failure> {
    let ServerInfo {
        version,
        durability,
        limits,
        ..
    } = session.client.server().await?;
    let (server, output) = (session.client.uri(), &mut session.output);
    // The names of the setting `data.durability`.
    let (durability, survives) = match durability {
        Durability::Memory => ("memory", "nothing: there is no data directory"),
        Durability::None => ("none", "an orderly stop of the server"),
        Durability::Os => ("os", "the end of the server, whatever ends it"),
        Durability::Fsync => ("fsync", "a loss of power"),
        _ => ("unknown", "this client does not know"),
    };
    if output.format == Format::Json {
        return Ok(output.json(&ServerLine {
            server,
            version: &version,
            durability,
            limits: LimitsLine {
                rows_per_call: limits.rows_per_call,
                ids_per_call: limits.ids_per_call,
                k: limits.k,
                request_bytes: limits.request_bytes,
                answer_bytes: limits.answer_bytes,
                payload_bytes: limits.payload_bytes,
                indexes: limits.indexes,
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
        limits.rows_per_call,
        limits.ids_per_call,
        bytes(limits.request_bytes),
        bytes(limits.answer_bytes)
    ))?;
    output.text(format_args!("k           {}", limits.k))?;
    output.text(format_args!("a payload   {}", bytes(limits.payload_bytes)))?;
    output.text(format_args!("indices     {}", limits.indexes))?;
    Ok(())
}
