//! The index of a call, the revision that a read sees, and its payloads.

use std::{mem, sync::Arc};

use bytes::Bytes;
use wayfold_proto::v1;

use super::{
    Call, Error, Service, Unavailability,
    answer::{missing, payload_bytes},
    check::Violations,
    error_map::registry_error,
    stored,
};
use crate::{
    admission::AnswerBytes,
    identity::Role,
    log::{LogError, View},
    registry::{Hosted, Published, RegistryError},
};

impl Service {
    /// Accepts a call of an index, as [`Service::accept`] does, and finds the index, which must have `uid` unless that
    /// is empty. A forwarded call finds no index that may be older than the one at the server that forwarded it.
    pub(super) fn index(
        &self,
        call: &Call,
        role: Role,
        name: &str,
        uid: &str,
    ) -> Result<Arc<Hosted>, Error> {
        let hosted = self.index_named(call, role, name, uid)?;
        check_uid(&hosted, uid)?;
        if let Some(uid) = call.forwarded_uid.filter(|uid| *uid != hosted.uid()) {
            // If the other index may be the later one, the server that has it evaluates the call. If this one is later, that
            // server has not heard of it.
            let uid = uid.to_string();
            if !hosted.is_past(&uid) {
                return Err(unknown(name, &uid));
            }
        }
        Ok(hosted)
    }

    /// Finds the index of this name, whatever its uid. If there is none but one with `uid` may still come from another
    /// server, the error is [`Error::UidUnknown`], not `IndexNotFound`.
    pub(super) fn index_named(
        &self,
        call: &Call,
        role: Role,
        name: &str,
        uid: &str,
    ) -> Result<Arc<Hosted>, Error> {
        self.accept(call, role, Some(name))?;
        let registry = self.registry()?;
        let hosted = registry.get(name).map_err(|error| match error {
            RegistryError::Deleted if !uid.is_empty() && !registry.is_past(name, uid, None) => {
                unknown(name, uid)
            }
            // No record is applied here, as if the index were closed: the server that forwarded the call goes on.
            RegistryError::Log(_) if call.is_forwarded => {
                Error::IndexNotFound { name: name.into() }
            }
            error => registry_error(name, error),
        })?;
        // A call of a stream finds it more than once.
        let _ = call.index.set(Arc::clone(hosted.label()));
        Ok(hosted)
    }

    /// Waits until the newest revision is at least `revision`, and returns it for a read. `revision` is the greater of
    /// `min_revision` and `since_revision`: a server that lacks these cannot list later points. A `latest` read sees
    /// every mutation that any server has acknowledged.
    pub(super) async fn published(
        &self,
        call: &Call,
        hosted: &Arc<Hosted>,
        revision: u64,
        latest: bool,
    ) -> Result<Arc<Published>, Error> {
        let mut revision = revision;
        if latest {
            let _waits = call.wait_in_place();
            match self.latest_of_owner(call, hosted).await? {
                Some(latest) => revision = revision.max(latest),
                None => {
                    const WAITING: &str = "while waiting for the latest revision";
                    self.latest(call, hosted, WAITING).await?;
                }
            }
        }
        let published = self.published_now(call, hosted).await?;
        if published.revision >= revision {
            return Ok(published);
        }
        const WAITING: &str = "while waiting for the revision that the call asks for";
        let reached = self
            .bounded(call, WAITING, hosted.reached(revision))
            .await?;
        reached.map_err(|error| registry_error(hosted.name(), error))
    }

    /// The published state. A server that has nothing of an index yet does not answer that there is nothing.
    pub(super) async fn published_now(
        &self,
        call: &Call,
        hosted: &Arc<Hosted>,
    ) -> Result<Arc<Published>, Error> {
        let published = hosted.published();
        if published.revision == 0 {
            if let Some(damage) = hosted.damage() {
                return Err(registry_error(hosted.name(), damage));
            }
            const ASKING: &str = "while waiting for the journal";
            let empty = self
                .bounded(call, ASKING, hosted.check_begins_empty())
                .await?;
            empty.map_err(|error| registry_error(hosted.name(), error))?;
        }
        Ok(published)
    }

    /// Waits for `future` until the deadline of the call, for `min_revision_wait` if its caller named none, and not beyond
    /// the server's shutdown: the revision may never come.
    async fn bounded<F: Future>(
        &self,
        call: &Call,
        doing: &'static str,
        future: F,
    ) -> Result<F::Output, Error> {
        let _waits = call.wait_in_place();
        let bounded = async {
            tokio::select! {
                biased;
                done = call.bound(doing, future) => done,
                () = self.stopping() => Err(Error::Unavailable { why: Unavailability::Stopping }),
            }
        };
        if call.deadline.is_some() && !call.has_default_deadline {
            return bounded.await;
        }
        tokio::time::timeout(self.limits().min_revision_wait, bounded)
            .await
            .map_err(|_| Error::DeadlineExceeded { doing })?
    }
}

/// The view of a call: a published revision of the named index.
pub(super) struct ReadView<'a> {
    pub(super) call: &'a Call,
    /// The activity that an exceeded deadline names.
    pub(super) doing: &'static str,
    pub(super) index: &'a str,
    pub(super) published: &'a Published,
}

impl ReadView<'_> {
    /// The payloads of at most [`BATCH_ROWS`](stored::BATCH_ROWS) points, in their order, up to the first that exceeds
    /// `most` bytes of an answer. The answer holds them in `held` from their read on: the call may wait long for its next turn.
    pub(super) async fn payloads(
        &self,
        ids: Vec<u64>,
        most: usize,
        held: &mut AnswerBytes,
    ) -> Result<Vec<Bytes>, Error> {
        // A read that outlives its call gives them back at its end.
        let mut lent = mem::take(held);
        let read = move |view: &dyn View| {
            let (mut payloads, mut bytes) = (Vec::new(), 0);
            for id in ids {
                if bytes > most {
                    break;
                }
                let payload = view.get(id)?.map(|point| point.payload.clone());
                let more = payload.as_ref().map_or(0, payload_bytes);
                if let Err(full) = lent.take(more) {
                    return Ok(Err(full));
                }
                bytes += more;
                payloads.push((id, payload));
            }
            Ok::<_, LogError>(Ok((payloads, lent)))
        };
        let read = stored::read(self.call, self.doing, self.index, self.published, read).await?;
        let (payloads, lent) = read?;
        *held = lent;
        let payloads = payloads
            .into_iter()
            .map(|(id, payload)| payload.ok_or_else(|| missing(id)));
        payloads.collect()
    }
}

/// The uid of the revision that a request names; empty for none.
pub(super) fn uid_of(named: Option<&v1::Revision>) -> &str {
    named.map_or("", |named| &named.uid)
}

/// A revision of `hosted`, as answers name it.
pub(super) fn revision(hosted: &Hosted, number: u64) -> v1::Revision {
    v1::Revision {
        uid: hosted.uid_text().into(),
        number,
    }
}

/// The number of the revision that a request names in `field`, 0 for none. A number above 0 needs a uid, and a uid must
/// match the index.
pub(super) fn revision_number(
    hosted: &Hosted,
    field: &str,
    named: Option<&v1::Revision>,
    violations: &mut Violations,
) -> Result<u64, Error> {
    let Some(v1::Revision { uid, number }) = named else {
        return Ok(0);
    };
    check_uid(hosted, uid)?;
    if *number > 0 {
        uid_is_named(field, uid, violations);
    }
    Ok(*number)
}

/// Notes a violation if a revision names no uid.
pub(super) fn uid_is_named(field: &str, uid: &str, violations: &mut Violations) {
    if uid.is_empty() {
        let text = "a revision needs the uid of the index that it belongs to";
        violations.add(format!("{field}.uid"), "REQUIRED", text);
    }
}

/// Fails if the index has another uid; an empty one matches any.
pub(super) fn check_uid(hosted: &Hosted, uid: &str) -> Result<(), Error> {
    if uid.is_empty() || uid == hosted.uid_text() {
        return Ok(());
    }
    match hosted.is_past(uid) {
        true => Err(Error::UidMismatch {
            index: hosted.name().into(),
            requested: uid.into(),
            found: hosted.uid_text().into(),
        }),
        false => Err(unknown(hosted.name(), uid)),
    }
}

/// The error of a call for an index with a uid of which this server has not heard.
pub(super) fn unknown(index: &str, requested: &str) -> Error {
    Error::UidUnknown {
        index: index.into(),
        requested: requested.into(),
    }
}

#[cfg(test)]
mod tests;
