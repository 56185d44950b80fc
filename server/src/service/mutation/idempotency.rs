//! The key by which a mutation and its retries take effect once.

use std::{mem::take, ops::Range, sync::Arc};

use bytes::Bytes;
use prost::Message;
use sha2::{Digest as _, Sha256};
use wayfold_proto::v1;

use crate::{
    log::{Batch, Digest, Effects, Operation},
    registry::{Hosted, WriteGuard},
    service::{Error, call::TimeSlicer},
};

/// Bytes of a request digested between two pauses.
const DIGEST_STEP_BYTES: usize = 64 * 1024;

/// The key by which a call and its retries take effect once.
pub(in crate::service) struct IdempotencyKey {
    name: Name,
    fingerprint: Digest,
}

/// The name by which a retry is recognised.
enum Name {
    Operation(String),
    /// A batch of a session, and the ids that it reserves.
    Batch(u64, u64, Range<u64>),
}

impl IdempotencyKey {
    /// The key of a request with this operation id; none if that is empty. The fingerprint covers the whole
    /// request, its operation id included.
    pub(in crate::service) async fn of(
        verb: &str,
        operation_id: &str,
        request: &impl Message,
        pace: &mut TimeSlicer,
    ) -> Result<Option<Self>, Error> {
        if operation_id.is_empty() {
            return Ok(None);
        }
        Ok(Some(Self {
            name: Name::Operation(operation_id.into()),
            fingerprint: fingerprint(verb, request, pace).await?,
        }))
    }

    /// The key of a batch of a session. The fingerprint leaves out the name and the uid of the index: a restored
    /// index has others, and recognises the retry.
    pub(in crate::service) async fn of_batch(
        request: &mut v1::WriteRequest,
        pace: &mut TimeSlicer,
    ) -> Result<Self, Error> {
        let index = (take(&mut request.index_name), take(&mut request.uid));
        let fingerprint = fingerprint("Write", request, pace).await;
        (request.index_name, request.uid) = index;
        Ok(Self {
            name: Name::Batch(request.session, request.batch, 0..0),
            fingerprint: fingerprint?,
        })
    }

    /// Sets the ids that the batch reserves.
    pub(in crate::service) fn reserve(&mut self, ids: Range<u64>) {
        if let Name::Batch(_, _, reserved) = &mut self.name {
            *reserved = ids;
        }
    }

    /// Adds the key to the effects of its mutation.
    pub(super) fn mark(&self, effects: &mut Effects, response: Bytes) {
        let fingerprint = self.fingerprint;
        match &self.name {
            Name::Operation(id) => effects.set_operation(Some(Arc::new(Operation {
                id: id.clone(),
                fingerprint,
                response,
            }))),
            Name::Batch(session, number, reserved) => effects.set_batch(Some(Arc::new(Batch {
                session: *session,
                number: *number,
                fingerprint,
                response,
                reserved: reserved.clone(),
                ended: Vec::new(),
            }))),
        }
    }
}

/// The digest of a call.
async fn fingerprint(
    verb: &str,
    request: &impl Message,
    pace: &mut TimeSlicer,
) -> Result<Digest, Error> {
    let mut hash = Sha256::new();
    hash.update(verb.as_bytes());
    for bytes in request.encode_to_vec().chunks(DIGEST_STEP_BYTES) {
        hash.update(bytes);
        pace.step().await?;
    }
    Ok(hash.finalize().into())
}

/// The response that the claimed mutation was given, if it took effect already.
pub(super) fn recalled<R: Message + Default>(
    hosted: &Hosted,
    writer: &WriteGuard,
    key: Option<&IdempotencyKey>,
) -> Result<Option<R>, Error> {
    let Some(key) = key else {
        return Ok(None);
    };
    let (fingerprint, response) = match &key.name {
        Name::Operation(id) => match hosted.recall(writer, id) {
            Some(operation) => (operation.fingerprint, operation.response.clone()),
            None => return Ok(None),
        },
        &Name::Batch(id, batch, _) => match writer.sessions().get(id) {
            Some(session) if batch > 0 && session.batch == batch => {
                (session.fingerprint, session.response.clone())
            }
            Some(session) if session.batch.checked_add(1) == Some(batch) => return Ok(None),
            session => {
                return Err(Error::SessionRefused {
                    index: hosted.name().into(),
                    session: id,
                    batch,
                    newest: session.map(|session| session.batch),
                });
            }
        },
    };
    if fingerprint != key.fingerprint {
        return Err(match &key.name {
            Name::Operation(id) => Error::OperationMismatch {
                operation_id: id.clone(),
            },
            &Name::Batch(session, batch, _) => Error::BatchMismatch { session, batch },
        });
    }
    let response = R::decode(response).map_err(|error| Error::Internal {
        what: format!("a remembered response does not decode: {error}"),
    })?;
    Ok(Some(response))
}
