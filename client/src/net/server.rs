//! The description of a server.

use wayfold_proto::v1;

use crate::Error;

/// A server: its version, its durability and its limits.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct ServerInfo {
    /// The version of the server program.
    pub version: String,
    /// The failures that an acknowledged mutation survives.
    pub durability: Durability,
    /// The server's limits.
    pub limits: Limits,
}

/// The failures that an acknowledged mutation survives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Durability {
    /// Nothing: the server has no data directory.
    Memory,
    /// An orderly stop of the server.
    None,
    /// Any end of the server process.
    Os,
    /// A loss of power.
    Fsync,
    /// A value that this client does not know.
    Other(i32),
}

/// The limits of a call, and the one of the number of indices. The server refuses a call that exceeds one with
/// `RESOURCE_EXHAUSTED`, or with `INVALID_ARGUMENT` for a payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Limits {
    /// The most states of one insert or search.
    pub max_rows_per_call: usize,
    /// The most ids of one get, update or remove.
    pub max_ids_per_call: usize,
    /// The most neighbours of one state.
    pub max_k: u64,
    /// The most bytes of one request message.
    pub max_request_bytes: usize,
    /// The most bytes of one answer message.
    pub max_answer_bytes: usize,
    /// The most bytes of one payload.
    pub max_payload_bytes: usize,
    /// The most indices of the server.
    pub max_indexes: u64,
    /// The most ids that one call reserves for a writer session.
    pub max_reserved_ids: u64,
    /// The most bytes of the stored points, with their payloads, whose tags or payloads one call sets.
    pub max_changed_point_bytes: usize,
}

impl Limits {
    /// No limits, for a call that cannot be divided.
    pub(crate) const NONE: Limits = Limits {
        max_rows_per_call: usize::MAX,
        max_ids_per_call: usize::MAX,
        max_k: u64::MAX,
        max_request_bytes: usize::MAX,
        max_answer_bytes: usize::MAX,
        max_payload_bytes: usize::MAX,
        max_indexes: u64::MAX,
        max_reserved_ids: u64::MAX,
        max_changed_point_bytes: usize::MAX,
    };
}

impl ServerInfo {
    pub(crate) fn from_message(
        call: &'static str,
        message: v1::GetServerResponse,
    ) -> Result<ServerInfo, Error> {
        let limits = message.limits;
        let limits = limits.ok_or_else(|| Error::protocol(call, "the server names no limits"))?;
        let size = |limit: u64| usize::try_from(limit).unwrap_or(usize::MAX);
        Ok(ServerInfo {
            version: message.version,
            durability: match message.durability {
                1 => Durability::Memory,
                2 => Durability::None,
                3 => Durability::Os,
                4 => Durability::Fsync,
                other => Durability::Other(other),
            },
            limits: Limits {
                max_rows_per_call: size(limits.max_rows_per_call),
                max_ids_per_call: size(limits.max_ids_per_call),
                max_k: limits.max_k,
                max_request_bytes: size(limits.max_request_bytes),
                max_answer_bytes: size(limits.max_answer_bytes),
                max_payload_bytes: size(limits.max_payload_bytes),
                max_indexes: limits.max_indexes,
                max_reserved_ids: limits.max_reserved_ids,
                max_changed_point_bytes: size(limits.max_changed_point_bytes),
            },
        })
    }
}
