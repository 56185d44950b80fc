//! The description of a server.

use wayfold_proto::v1;

use crate::Error;

/// A server: its version, what an acknowledged mutation survives, and its limits.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct ServerInfo {
    /// The version of the server program.
    pub version: String,
    /// The failures that an acknowledged mutation survives.
    pub durability: Durability,
    /// The limits of one call.
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
    /// The end of the server, whatever ends it.
    Os,
    /// A loss of power.
    Fsync,
    /// Something that this client does not know.
    Other(i32),
}

/// The limits of one call. The server refuses a call that exceeds them with `RESOURCE_EXHAUSTED`, or with
/// `INVALID_ARGUMENT` for a payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Limits {
    /// States of one insert or search.
    pub rows_per_call: usize,
    /// Ids of one get, update or remove.
    pub ids_per_call: usize,
    /// Neighbours of one state.
    pub k: u64,
    /// Bytes of one request message.
    pub request_bytes: usize,
    /// Bytes of one answer message.
    pub answer_bytes: usize,
    /// Bytes of one payload.
    pub payload_bytes: usize,
    /// Indices of the server.
    pub indexes: u64,
}

impl Limits {
    /// No limits, for a call that cannot be divided.
    pub(crate) const NONE: Limits = Limits {
        rows_per_call: usize::MAX,
        ids_per_call: usize::MAX,
        k: u64::MAX,
        request_bytes: usize::MAX,
        answer_bytes: usize::MAX,
        payload_bytes: usize::MAX,
        indexes: u64::MAX,
    };
}

impl ServerInfo {
    pub(crate) fn from_message(
        call: &'static str,
        message: v1::GetServerResponse,
    ) -> Result<ServerInfo, Error> {
        let limits = message.limits.ok_or_else(|| Error::Protocol {
            call,
            problem: "the server names no limits".to_owned(),
        })?;
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
                rows_per_call: size(limits.rows_per_call),
                ids_per_call: size(limits.ids_per_call),
                k: limits.k,
                request_bytes: size(limits.request_bytes),
                answer_bytes: size(limits.answer_bytes),
                payload_bytes: size(limits.payload_bytes),
                indexes: limits.indexes,
            },
        })
    }
}
