//! The frame of every mutation: it recognises a retry, waits for the writer, commits the effects and acknowledges them.

use std::sync::Arc;

use prost::Message;
use sha2::{Digest as _, Sha256};

use super::{Call, Error, Service, call::Pace, error_map::registry_error};
use crate::{
    log::{Digest, Effects, Operation},
    registry::{Committed, Hosted, OperationWindow, WriteGuard},
};

/// Bytes of a request digested between two pauses.
const STRETCH: usize = 64 * 1024;

/// A call's claim to take effect once.
pub(super) struct Claim {
    id: String,
    fingerprint: Digest,
}

impl Claim {
    /// The claim of a request with this operation id; none if that is empty. The fingerprint covers the whole
    /// request, its operation id included.
    pub(super) async fn of(
        verb: &str,
        operation_id: &str,
        request: &impl Message,
        pace: &mut Pace,
    ) -> Result<Option<Self>, Error> {
        if operation_id.is_empty() {
            return Ok(None);
        }
        let mut hash = Sha256::new();
        hash.update(verb.as_bytes());
        for stretch in request.encode_to_vec().chunks(STRETCH) {
            hash.update(stretch);
            pace.step().await?;
        }
        Ok(Some(Self {
            id: operation_id.into(),
            fingerprint: hash.finalize().into(),
        }))
    }
}

/// The start of a mutation.
pub(super) enum Start<R> {
    /// The operation took effect before; this is its response.
    Remembered(R),
    /// The call holds the writer.
    Writing(WriteGuard),
}

impl Service {
    /// Waits for the writer of an index, unless the claimed operation took effect already.
    pub(super) async fn begin<R: Message + Default>(
        &self,
        call: &Call,
        hosted: &Hosted,
        claim: Option<&Claim>,
    ) -> Result<Start<R>, Error> {
        loop {
            let writer = call
                .bound(
                    "while waiting for other mutations of the index",
                    hosted.write(),
                )
                .await?
                .map_err(|error| registry_error(hosted.name(), error))?;
            let Some(response) = recalled(hosted, &writer, claim)? else {
                return Ok(Start::Writing(writer));
            };
            if settled(call, hosted, writer).await? == Committed::Done {
                return Ok(Start::Remembered(response));
            }
        }
    }

    /// Commits a mutation that was evaluated under `writer`; returns [`Committed::Done`] once it may be acknowledged with
    /// `response`. Before the first poll nothing has happened; after it the mutation completes or is refused.
    pub(super) async fn commit(
        &self,
        call: &Call,
        hosted: &Arc<Hosted>,
        writer: WriteGuard,
        mut effects: Effects,
        claim: Option<&Claim>,
        response: &impl Message,
    ) -> Result<Committed, Error> {
        call.check("before anything was changed")?;
        let window = OperationWindow {
            count: self.limits().max_operations,
            bytes: self.limits().max_operation_bytes,
        };
        let operation = claim.map(|claim| {
            Arc::new(Operation {
                id: claim.id.clone(),
                fingerprint: claim.fingerprint,
                response: response.encode_to_vec().into(),
            })
        });
        if effects.is_empty() {
            // A twin that is under way finds it, and waits for the same records.
            if let Some(operation) = operation {
                hosted.remember(operation, window);
            }
            let committed = settled(call, hosted, writer).await?;
            if let (Committed::Refused, Some(claim)) = (committed, claim) {
                hosted.forget(&claim.id);
            }
            return Ok(committed);
        }
        effects.set_operation(operation);
        call.bound(
            "after the mutation was logged; it takes place",
            hosted.commit(writer, effects, window),
        )
        .await?
        .map_err(|error| registry_error(hosted.name(), error))
    }
}

/// The response that the claimed operation was given, if it took effect already.
fn recalled<R: Message + Default>(
    hosted: &Hosted,
    writer: &WriteGuard,
    claim: Option<&Claim>,
) -> Result<Option<R>, Error> {
    let Some(claim) = claim else {
        return Ok(None);
    };
    let Some(operation) = hosted.recall(writer, &claim.id) else {
        return Ok(None);
    };
    if operation.fingerprint != claim.fingerprint {
        return Err(Error::OperationMismatch {
            operation_id: claim.id.clone(),
        });
    }
    let response = R::decode(operation.response.clone()).map_err(|error| Error::Internal {
        what: format!(
            "operation \"{}\": its response does not decode: {error}",
            claim.id
        ),
    })?;
    Ok(Some(response))
}

/// Waits until all that a response was evaluated against is as durable as configured.
async fn settled(call: &Call, hosted: &Hosted, writer: WriteGuard) -> Result<Committed, Error> {
    call.bound("while the log was being synced", hosted.settled(writer))
        .await?
        .map_err(|error| registry_error(hosted.name(), error))
}
