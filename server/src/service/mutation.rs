//! The frame of every mutation: it recognises a retry, waits for the writer, commits the effects and acknowledges them.

mod idempotency;

use std::sync::Arc;

use prost::Message;

use super::{
    Call, Error, Service, changed_points::ChangedPoints, error_map::registry_error,
    stored::MAX_READS_AHEAD,
};
use crate::{
    log::Effects,
    registry::{CommitOutcome, Hosted, WriteGuard},
};
pub(super) use idempotency::IdempotencyKey;
use idempotency::recalled;

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
        hosted: &Arc<Hosted>,
        key: Option<&IdempotencyKey>,
    ) -> Result<Start<R>, Error> {
        let mut is_caught_up = false;
        loop {
            self.may_write(call, hosted).await?;
            let waiting = async {
                // All clients of the server that forwards have one connection. Without their numbers they would wait for each
                // other.
                let _turn = match &call.permits {
                    Some(permits) if call.is_forwarded == call.forwarded_client.is_some() => {
                        let uid = *hosted.uid().as_bytes();
                        permits.write(uid, call.forwarded_client).await
                    }
                    _ => None,
                };
                hosted.write().await
            };
            let doing = "while waiting for other mutations of the index";
            let writer = call.bound(doing, waiting).await?;
            let writer = match writer {
                // The index takes no records here: the server that forwarded the call goes on.
                Err(_) if call.is_forwarded => {
                    let name = hosted.name().into();
                    return Err(Error::IndexNotFound { name });
                }
                writer => writer.map_err(|error| registry_error(hosted.name(), error))?,
            };
            if !self.is_compared(hosted) {
                // The members changed while this call waited for others.
                continue;
            }
            let recalled = match recalled(hosted, &writer, key) {
                // The session may have moved on in records that this server lacks, or that the journal has not accepted
                // yet: catch up and look once more.
                Err(Error::SessionRefused { .. }) if !is_caught_up => {
                    is_caught_up = true;
                    if hosted.is_shared() {
                        drop(writer);
                        let doing = "while reading the journal";
                        let caught_up = call.bound(doing, hosted.catch_up()).await?;
                        caught_up.map_err(|error| registry_error(hosted.name(), error))?;
                        self.latest(call, hosted, doing).await?;
                    } else {
                        let _ = confirm_current(call, hosted, writer).await?;
                    }
                    continue;
                }
                // The journal may refuse the pending records that the error comes from.
                Err(error) => {
                    refused(call, hosted, writer, error).await?;
                    continue;
                }
                Ok(recalled) => recalled,
            };
            let Some(response) = recalled else {
                return Ok(Start::Writing(writer));
            };
            if confirm_current(call, hosted, writer).await? == CommitOutcome::Done {
                return Ok(Start::Remembered(response));
            }
        }
    }

    /// Waits until every mutation that any server acknowledged before is published here. That makes a record, so the records
    /// of the members are compared as before a mutation.
    pub(super) async fn latest(
        &self,
        call: &Call,
        hosted: &Arc<Hosted>,
        doing: &'static str,
    ) -> Result<(), Error> {
        loop {
            self.may_write(call, hosted).await?;
            let latest = hosted.latest(|| self.is_compared(hosted));
            let latest = call.bound(doing, latest).await?;
            // The members may have changed while this call waited for others.
            if latest.map_err(|error| registry_error(hosted.name(), error))? {
                return Ok(());
            }
        }
    }

    /// Like [`Service::begin`], with the stored points of `ids` read, as of the writer's newest record.
    pub(super) async fn begin_with<R: Message + Default>(
        &self,
        call: &Call,
        hosted: &Arc<Hosted>,
        key: Option<&IdempotencyKey>,
        stored: &mut ChangedPoints,
        ids: &[u64],
    ) -> Result<Start<R>, Error> {
        let mut base = hosted.published();
        let mut reads = 0;
        loop {
            let too_large = match stored.read(call, hosted, &base, ids).await {
                Ok(()) => None,
                // A retry of an operation that took effect is answered, even if its points have grown since.
                Err(error @ Error::LimitExceeded { .. }) => Some(error),
                Err(error) => return Err(error),
            };
            let writer = match self.begin(call, hosted, key).await? {
                Start::Writing(writer) => writer,
                remembered @ Start::Remembered(_) => return Ok(remembered),
            };
            if let Some(error) = too_large {
                refused(call, hosted, writer, error).await?;
                base = hosted.published();
                continue;
            }
            base = Arc::clone(writer.base());
            reads += 1;
            let mut caught_up = stored.catch_up(hosted, &writer);
            // It is false only if the cached records do not reach back to the read, or some of them were refused since.
            if caught_up == Ok(false) && reads >= MAX_READS_AHEAD {
                let read = stored.read(call, hosted, &base, ids).await;
                caught_up = read.and_then(|()| stored.catch_up(hosted, &writer).map(|_| true));
            }
            match caught_up {
                Ok(true) => return Ok(Start::Writing(writer)),
                Ok(false) => {}
                Err(error) => {
                    refused(call, hosted, writer, error).await?;
                    base = hosted.published();
                }
            }
        }
    }

    /// Commits the effects that were `evaluated` under `writer`; returns the response once the mutation may be acknowledged
    /// with it, or `None` if it has to be evaluated again. Before the first poll nothing has happened; after it the mutation
    /// completes or is refused.
    pub(super) async fn commit<R: Message>(
        &self,
        call: &Call,
        hosted: &Arc<Hosted>,
        writer: WriteGuard,
        key: Option<&IdempotencyKey>,
        evaluated: Result<(Effects, R), Error>,
    ) -> Result<Option<R>, Error> {
        let (mut effects, response) = match evaluated {
            Ok(evaluated) => evaluated,
            Err(error) => {
                refused(call, hosted, writer, error).await?;
                return Ok(None);
            }
        };
        call.check("before anything was changed")?;
        let (index, limits) = (hosted.name(), self.limits());
        let inserted = effects.inserted();
        let fits = || {
            // A full index takes what makes it no larger.
            if inserted > effects.removed().len() {
                let points = writer.points() + inserted - effects.removed().len();
                limits.check_quotas(index, hosted.space(), points as u64)?;
            }
            if limits.max_payload_bytes_per_index > 0 && effects.has_payloads() {
                let bytes = |effects: &Effects| hosted.payload_bytes(&writer, effects);
                let after = bytes(&effects);
                let fits = limits.check_payloads(index, after);
                // Above a quota that was lowered, a mutation may make the payloads smaller.
                if fits.is_err() && after > bytes(&Effects::new(0)) {
                    return fits;
                }
            }
            Ok(())
        };
        if let Err(error) = fits() {
            refused(call, hosted, writer, error).await?;
            return Ok(None);
        }
        if let Some(key) = key {
            key.mark(&mut effects, response.encode_to_vec().into());
        }
        // The record holds the response too.
        if let Err(error) = hosted.check_size(&effects) {
            refused(call, hosted, writer, registry_error(index, error)).await?;
            return Ok(None);
        }
        // With a shared journal the response may be stale until the journal accepts a record after it. That record holds the
        // operation, so every server remembers it.
        if effects.is_empty() && !hosted.is_shared() {
            // A concurrent retry finds the operation, and waits for the same records.
            if let Some(operation) = effects.operation() {
                let remembered = hosted.remember(Arc::clone(operation));
                remembered.map_err(|error| registry_error(index, error))?;
            }
            let committed = confirm_current(call, hosted, writer).await?;
            return Ok((committed == CommitOutcome::Done).then_some(response));
        }
        let doing = match hosted.is_shared() {
            true => {
                "before the journal answered; the mutation may take place: repeat the call with its operation_id"
            }
            false => "before the mutation was durable; it may take place",
        };
        let committed = call.bound(doing, hosted.commit(writer, effects)).await?;
        let committed = committed.map_err(|error| registry_error(hosted.name(), error))?;
        Ok((committed == CommitOutcome::Done).then_some(response))
    }
}

/// Returns `error`, or Ok if the mutation has to be evaluated again. With a shared journal the state under `writer` may be
/// stale: the error counts only once the journal has accepted an empty record after it.
pub(super) async fn refused(
    call: &Call,
    hosted: &Hosted,
    writer: WriteGuard,
    error: Error,
) -> Result<(), Error> {
    // The end of a call and the room for its answer do not depend on the records.
    let is_end = matches!(
        error,
        Error::DeadlineExceeded { .. } | Error::Denied { .. } | Error::TooManyBytes { .. }
    );
    if hosted.is_shared()
        && !is_end
        && confirm_current(call, hosted, writer).await? == CommitOutcome::Refused
    {
        return Ok(());
    }
    Err(error)
}

/// Waits until all that a response was evaluated against is as durable as configured.
async fn confirm_current(
    call: &Call,
    hosted: &Hosted,
    writer: WriteGuard,
) -> Result<CommitOutcome, Error> {
    call.bound(
        "while the log was being synced",
        hosted.confirm_current(writer),
    )
    .await?
    .map_err(|error| registry_error(hosted.name(), error))
}

#[cfg(test)]
mod tests {
    use futures_util::{StreamExt, stream::FuturesUnordered};
    use wayfold_proto::v1;

    use super::*;
    use crate::{
        admission::ClientPermits,
        testing::{arm, log_with, server},
    };

    /// The revision of an insert of the second client that comes after five of the first.
    async fn revision_of_last([many, one]: [Call; 2]) -> u64 {
        let log = log_with(&arm(), &[]);
        let service = &server(&log, &log);
        let hosted = service.registry().unwrap().get("arm").unwrap();
        let insert = |call| async move {
            let states = v1::States {
                row_count: 1,
                coordinates: vec![0.5],
            };
            let request = v1::InsertRequest {
                index_name: "arm".into(),
                states: Some(states),
                ..Default::default()
            };
            let inserted = service.insert(call, request).await.unwrap();
            inserted.revision.unwrap().number
        };
        let writer = hosted.write().await.unwrap();
        let mut others: FuturesUnordered<_> = (0..5).map(|_| insert(&many)).collect();
        assert!(futures_util::poll!(others.next()).is_pending());
        let mut last = Box::pin(insert(&one));
        assert!(futures_util::poll!(&mut last).is_pending());
        drop(writer);
        let (revision, _) = tokio::join!(last, others.collect::<Vec<_>>());
        revision
    }

    #[tokio::test]
    async fn a_mutation_waits_for_at_most_one_of_each_other_client() {
        let calls = [(); 2].map(|()| Call {
            permits: Some(Arc::new(ClientPermits::new(1))),
            ..Call::default()
        });
        assert_eq!(revision_of_last(calls).await, 2);
    }

    #[tokio::test]
    async fn a_forwarded_mutation_waits_for_at_most_one_of_each_other_client() {
        let connection = Arc::new(ClientPermits::new(1));
        let calls = [1, 2].map(|client| Call {
            is_forwarded: true,
            forwarded_client: Some(client),
            permits: Some(Arc::clone(&connection)),
            ..Call::default()
        });
        assert_eq!(revision_of_last(calls).await, 2);
    }
}
