//! Any of the three mutations, sent and applied to the model.

use std::fmt::Debug;

use prost::Message;
use rand::{Rng, RngExt};
use wayfold_proto::v1;
use wayfold_server::service::Service;

use crate::{
    model::{Model, Refused},
    random::{Requests, refused},
    support::*,
};

#[derive(Clone, Debug)]
pub(super) enum Mutation {
    Insert(v1::InsertRequest),
    Update(v1::UpdateRequest),
    Remove(v1::RemoveRequest),
}

/// An answer as text and as encoded bytes, so that comparisons are exact to the last bit.
pub(super) type Reply = Result<(String, Vec<u8>), Refused>;

fn reply<M: Message + Debug>(answer: Result<M, Refused>) -> Reply {
    answer.map(|answer| (format!("{answer:?}"), answer.encode_to_vec()))
}

impl Mutation {
    pub(super) fn draw(
        random: &mut impl Rng,
        requests: &mut Requests,
        revision: u64,
        operation_id: String,
    ) -> Self {
        match random.random_range(0..8) {
            0..=4 => Self::Insert(v1::InsertRequest {
                operation_id,
                ..requests.insert(revision)
            }),
            5..=6 => Self::Update(v1::UpdateRequest {
                operation_id,
                ..requests.update(revision)
            }),
            _ => Self::Remove(v1::RemoveRequest {
                operation_id,
                ..requests.remove()
            }),
        }
    }

    pub(super) async fn send(&self, service: &Service) -> Reply {
        match self.clone() {
            Self::Insert(request) => reply(refused(service.insert(&CALL, request).await)),
            Self::Update(request) => reply(refused(service.update(&CALL, request).await)),
            Self::Remove(request) => reply(refused(service.remove(&CALL, request).await)),
        }
    }

    pub(super) fn apply(&self, model: &mut Model) -> Reply {
        match self {
            Self::Insert(request) => reply(model.insert(request)),
            Self::Update(request) => reply(model.update(request)),
            Self::Remove(request) => reply(Ok(model.remove(request))),
        }
    }
}
