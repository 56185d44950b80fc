//! `RestoreIndex`: an index from the parts of a snapshot.

use std::{sync::Arc, time::Duration};

use bytes::Bytes;
use futures_util::future::join_all;
use prost::Message;
use tokio::{
    task::JoinError,
    time::{MissedTickBehavior, interval, timeout},
};
use tracing::{Instrument, warn};
use wayfold_proto::{
    snapshot::{Content, Reader, SnapshotError},
    v1,
};

use super::{
    Call, Error, Service,
    check::Violations,
    error_map::registry_error,
    indexes::{check_name, describe, too_many_indexes},
    member::StoredRequest,
    peer_comparison::ANSWER_TIME,
    session_pages::{add_restored, memory_bytes},
};
use crate::{
    identity::{Caller, Role},
    log::{Durability, Origin, Record, Sessions, StoredPoint},
    registry::{AwaitedCopy, Hosted, RegistryError, Restore},
};

/// The most bytes of the first part, which has the header alone.
const MAX_FIRST_PART_BYTES: usize = 1024 * 1024;

/// The first revision that no snapshot may have: an index that is restored needs revisions for its mutations.
const END_OF_REVISIONS: u64 = 1 << 63;

/// An index under restoration. It is invisible until [`RestoreCall::finish`], and a drop leaves nothing behind.
pub struct RestoreCall {
    service: Service,
    call: Call,
    /// Set by the first message.
    name: Option<String>,
    /// Taken while a part is read; never put back if that failed or was cancelled.
    draft: Option<RestoreDraft>,
}

/// The restored part of the index.
#[derive(Default)]
struct RestoreDraft {
    reader: Reader,
    /// Set by the header.
    restore: Option<Restore>,
    sessions: Sessions,
}

impl Service {
    /// Begins to restore an index from a snapshot.
    pub fn restore_index(&self, call: &Call) -> Result<RestoreCall, Error> {
        self.accept(call, Role::Admin, None)?;
        Ok(RestoreCall {
            service: self.clone(),
            call: call.clone(),
            name: None,
            draft: Some(RestoreDraft::default()),
        })
    }
}

/// The time between two checks for a copy of a restored index.
const COPY_INTERVAL: Duration = Duration::from_millis(200);

impl Service {
    /// Waits until another server of a cluster has a copy of a restored index: its points are in no journal. The only live
    /// server of a cluster does not wait. However the wait ends, mutations are taken then: they do not depend on a server that
    /// may never come back.
    async fn await_copy(
        self,
        hosted: Arc<Hosted>,
        _awaited: Option<AwaitedCopy>,
    ) -> Result<(), Error> {
        let Some(peers) = self.inner.peers.get() else {
            return Ok(());
        };
        let revision = hosted.published().revision;
        let is_durable = self.inner.durability == Some(Durability::Fsync);
        let copied = async {
            peers.wait_for_members().await;
            let mut checks = interval(COPY_INTERVAL);
            checks.set_missed_tick_behavior(MissedTickBehavior::Delay);
            loop {
                checks.tick().await;
                // A server that is cut off sees none, not even itself.
                if self.members() == 1 {
                    warn!(
                        index = hosted.name(),
                        uid = hosted.uid_text(),
                        "no other server is live: a restored index is on this one alone"
                    );
                    return;
                }
                let members = peers.peers(hosted.uid());
                let answers = members.iter().map(|member| {
                    let request = StoredRequest {
                        uids: vec![hosted.uid_text().into()],
                        revisions: Vec::new(),
                    };
                    timeout(ANSWER_TIME, peers.stored(member, request))
                });
                let has_copy = join_all(answers).await.into_iter().any(|answer| {
                    let stored = answer.ok().and_then(Result::ok);
                    let stored = stored.and_then(|stored| stored.indexes.into_iter().next());
                    // A copy in memory alone does not outlive a loss of power.
                    stored.is_some_and(|stored| {
                        stored.revision >= revision && (stored.is_durable || !is_durable)
                    })
                });
                let is_deleted = self
                    .registry()
                    .is_ok_and(|it| it.by_uid(hosted.uid()).is_none());
                if has_copy || is_deleted {
                    return;
                }
            }
        };
        let max_time = Duration::from_secs(self.limits().max_scan_seconds);
        timeout(max_time, copied).await.map_err(|_| {
            warn!(
                index = hosted.name(),
                uid = hosted.uid_text(),
                "no other server has taken a copy: a restored index is on this one alone, and takes mutations now"
            );
            uncopied(&hosted)
        })
    }
}

impl RestoreCall {
    /// Takes the next part. After an error every part is refused.
    pub async fn add(&mut self, request: v1::RestoreIndexRequest) -> Result<(), Error> {
        let name = self.name(request.name)?;
        Service::authorize(&self.call, Role::Admin, Some(&name))?;
        let Some(part) = request.part else {
            return Err(refused("REQUIRED", "a message without a part".into()));
        };
        let mut draft = self.draft.take().ok_or_else(out_of_order)?;
        let caller = self.call.caller.clone();
        let is_first = draft.restore.is_none();
        let bytes = part.encoded_len();
        if is_first && bytes > MAX_FIRST_PART_BYTES {
            let text = format!(
                "the first part, the header, has {bytes} bytes, more than {MAX_FIRST_PART_BYTES}"
            );
            return Err(refused("TOO_LARGE", text));
        }
        let read = move |service: &Service| {
            draft.read(service, &caller, &name, &part)?;
            Ok::<_, Error>(draft)
        };
        // Its work takes milliseconds of a thread that may block, and waits for other changes.
        let draft = self.service.change(&self.call, read).await??;
        self.draft = Some(draft);
        Ok(())
    }

    /// Ends the parts. If the snapshot is whole, the index is visible from now on.
    pub async fn finish(mut self) -> Result<v1::RestoreIndexResponse, Error> {
        self.call.check("while restoring")?;
        let draft = self.draft.take().ok_or_else(out_of_order)?;
        let (reader, restore, sessions) = (draft.reader, draft.restore, draft.sessions);
        reader.finish().map_err(bad)?;
        let (Some(name), Some(restore)) = (self.name, restore) else {
            return Err(out_of_order());
        };
        let finished = self.service.change(&self.call, move |service| {
            // The maintenance serves the index once it has its name, maybe before `host` returns.
            let awaited = service.inner.peers.get().map(|_| restore.await_copy());
            let hosted = service.registry()?.host(restore, sessions);
            let hosted = hosted.map_err(|error| not_restored(&name, error))?;
            // It goes on if the caller leaves, so that mutations wait for the copy all the same.
            let copied = service.clone().await_copy(Arc::clone(&hosted), awaited);
            Ok::<_, Error>((hosted, tokio::spawn(copied.in_current_span())))
        });
        let (hosted, copied) = finished.await??;
        let doing = "while another server took a copy";
        let copied = self.call.bound(doing, copied).await;
        copied.map_err(|_| uncopied(&hosted))?.map_err(stopped)??;
        Ok(v1::RestoreIndexResponse {
            index: Some(describe(&hosted, &hosted.published())),
        })
    }

    /// The index's name: the first message gives it, and no later one may differ.
    fn name(&mut self, given: String) -> Result<String, Error> {
        let mut violations = Violations::default();
        let name = match &self.name {
            Some(name) => {
                if !given.is_empty() && given != *name {
                    let text = format!("{given:?}, where the first message says {name:?}");
                    violations.add("name", "AMBIGUOUS", text);
                }
                name.clone()
            }
            None => {
                check_name(&given, &mut violations);
                given
            }
        };
        violations.finish()?;
        self.name = Some(name.clone());
        Ok(name)
    }
}

impl RestoreDraft {
    fn read(
        &mut self,
        service: &Service,
        caller: &Caller,
        name: &str,
        part: &v1::SnapshotPart,
    ) -> Result<(), Error> {
        let content = self.reader.read(part).map_err(bad)?;
        match (content, &mut self.restore) {
            (Content::Header(header), restore) => {
                if header.revision >= END_OF_REVISIONS {
                    let text = format!("revision {}: it is below 2^63", header.revision);
                    return Err(refused("OUT_OF_RANGE", text));
                }
                let origin = Origin {
                    revision: header.revision,
                    next_id: header.next_id,
                    digest: match header.revision {
                        // Other servers know an index without records by this digest.
                        0 => Record::NO_PREVIOUS,
                        _ => *self.reader.digest(),
                    },
                };
                let limits = service.limits();
                limits.check_quotas(name, &header.space, header.point_count)?;
                let limits = service.index_limits(caller);
                let begun = service.registry()?.restore(
                    name,
                    (header.space, header.payload_encoding),
                    limits,
                    origin,
                );
                *restore = Some(begun.map_err(|error| not_restored(name, error))?);
            }
            (Content::Points(points, modified), Some(restore)) => {
                restore
                    .add(&stored(points, &modified))
                    .map_err(|error| not_restored(name, error))?;
                service
                    .limits()
                    .check_payloads(name, restore.payload_bytes())?;
            }
            (Content::Sessions(sessions), Some(restore)) => {
                restore
                    .admit(memory_bytes(&sessions))
                    .map_err(|error| not_restored(name, error))?;
                add_restored(&mut self.sessions, sessions, service.limits())?;
            }
            (Content::Trailer, Some(_)) => {}
            // The reader refuses these before the header.
            (Content::Points(..) | Content::Sessions(_) | Content::Trailer, None) => {
                return Err(out_of_order());
            }
        }
        Ok(())
    }
}

/// The points of a part that the reader accepted.
pub(super) fn stored(points: v1::Points, modified: &[u64]) -> Vec<StoredPoint> {
    let states = points.states.unwrap_or_default();
    let width = states.coordinates.len() / points.ids.len().max(1);
    let columns = points.ids.iter().zip(&points.tags);
    let columns = columns.zip(points.revisions.iter().zip(modified));
    let rows = states.coordinates.chunks_exact(width.max(1));
    let rows = columns.zip(rows).enumerate();
    rows.map(
        |(at, (((&id, &tag), (&revision, &modified)), state))| StoredPoint {
            id,
            revision,
            modified,
            tag,
            state: state.into(),
            // A copy, so that the part can be freed.
            payload: points
                .payloads
                .get(at)
                .map_or_else(Bytes::new, |payload| Bytes::copy_from_slice(payload)),
        },
    )
    .collect()
}

fn bad(error: SnapshotError) -> Error {
    refused(error.reason(), error.to_string())
}

fn refused(reason: &'static str, description: String) -> Error {
    let mut violations = Violations::default();
    violations.add("part", reason, description);
    match violations.finish() {
        Err(error) => error,
        Ok(()) => out_of_order(),
    }
}

fn not_restored(name: &str, error: RegistryError) -> Error {
    match error {
        RegistryError::Taken => Error::NameTaken { name: name.into() },
        RegistryError::TooManyIndexes { setting, max } => too_many_indexes(setting, max),
        error => registry_error(name, error),
    }
}

/// The error of a restore whose index no other server has copied.
fn uncopied(hosted: &Hosted) -> Error {
    Error::StorageFailed {
        what: format!(
            "index \"{}\" is restored on this server, and no other server has a copy yet: do not restore it again, and keep the \
             directory of this server",
            hosted.name()
        ),
    }
}

fn out_of_order() -> Error {
    Error::Internal {
        what: "a restore went on after its end".into(),
    }
}

fn stopped(_: JoinError) -> Error {
    Error::Internal {
        what: "the task that restores an index panicked".into(),
    }
}
