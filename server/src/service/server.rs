//! `GetServer`: version, durability and limits of the server.

use wayfold_proto::v1;

use super::{Call, Error, Service, changed_points::max_changed_bytes};
use crate::{identity::Role, log::Durability};

impl Service {
    /// Describes the server to the caller of a face that reads requests of at most `max_request_bytes` bytes.
    pub async fn get_server(
        &self,
        call: &Call,
        _: v1::GetServerRequest,
        max_request_bytes: usize,
    ) -> Result<v1::GetServerResponse, Error> {
        self.accept(call, Role::Read, None)?;
        let durability = match self.inner.durability {
            None => v1::Durability::Memory,
            Some(Durability::None) => v1::Durability::None,
            Some(Durability::Os) => v1::Durability::Os,
            Some(Durability::Fsync) => v1::Durability::Fsync,
        };
        let limits = self.limits();
        Ok(v1::GetServerResponse {
            version: env!("CARGO_PKG_VERSION").into(),
            durability: durability.into(),
            limits: Some(v1::Limits {
                max_rows_per_call: limits.max_rows_per_call as u64,
                max_ids_per_call: limits.max_ids_per_call as u64,
                max_k: limits.max_k as u64,
                max_request_bytes: max_request_bytes as u64,
                max_answer_bytes: limits.max_answer_bytes as u64,
                max_payload_bytes: limits.max_payload_bytes as u64,
                max_indexes: limits.max_indexes as u64,
                max_reserved_ids: limits.max_reserved_ids,
                max_changed_point_bytes: max_changed_bytes(&call.answer_bytes()) as u64,
            }),
        })
    }
}
