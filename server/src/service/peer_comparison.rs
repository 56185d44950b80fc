//! Before a server makes its first record of an index, for a mutation or a `latest` read, it compares its newest records
//! with those of the live members of its cluster. NATS may have lost records that another member still has, and a record
//! of this server would take their place for good.
//!
//! The members are asked again once they change, once NATS is connected again, and once the index resumes: the owner of an
//! index may have changed, a member that joins may have other records, and NATS may have lost some. Later mutations compare
//! two numbers. A contradiction stands in the catalogue, so that it outlives every server, until an operator chooses.

use std::{
    sync::{Arc, atomic::Ordering::Relaxed},
    time::Duration,
};

use futures_util::future::join_all;
use tokio::time::{Instant, timeout};
use tracing::debug;

use super::{
    Call, Error, Owners, Peers, Service,
    error_map::registry_error,
    member::{StoredIndex, StoredRequest},
};
use crate::{
    log::{Digest, RecordPosition},
    registry::{ComparisonFailure, Hosted},
};

/// The time in which a member answers about its records; a slower one does not count.
pub(super) const ANSWER_TIME: Duration = Duration::from_secs(2);

/// The time in which the records of a member that is ahead arrive. The member publishes again what NATS has lost within
/// seconds.
const ARRIVAL_TIME: Duration = Duration::from_secs(5);

const DOING: &str = "while asking the other servers for their records; nothing was changed";

impl Service {
    /// Fails if another member has applied records that this server lacks, or others of the same revision, or if no other member
    /// has the points of a restored index yet.
    pub(super) async fn may_write(&self, call: &Call, hosted: &Arc<Hosted>) -> Result<(), Error> {
        let Some((owners, peers)) = self.inner.owners.get().zip(self.inner.peers.get()) else {
            return Ok(());
        };
        if self.is_compared(hosted) {
            return Ok(());
        }
        if let Some(why) = hosted.contradiction() {
            return Err(registry_error(hosted.name(), why));
        }
        // A restored index is not compared before its wait has ended, so no call passes by `is_compared`.
        if hosted.awaits_copy() {
            return Err(Error::StorageFailed {
                what: format!(
                    "index \"{}\" was restored on this server, and no other server has its points yet; nothing was changed, so \
                     call again",
                    hosted.name()
                ),
            });
        }
        if hosted.is_closed() {
            return Ok(());
        }
        let (owners, peers) = (Arc::clone(owners), Arc::clone(peers));
        // It goes on if the caller leaves: the next one finds the outcome.
        let comparing = tokio::spawn(compare_in_turn(owners, peers, Arc::clone(hosted)));
        let compared = call.bound(DOING, comparing).await?;
        compared.unwrap_or_else(|_| {
            Err(Error::Internal {
                what: "the task that asks the other servers for their records panicked".into(),
            })
        })
    }

    /// True if neither the members have changed nor the index has resumed since their records were compared with those of this
    /// server, and no server has found a contradiction.
    pub(super) fn is_compared(&self, hosted: &Hosted) -> bool {
        let cluster = self.inner.owners.get().zip(self.inner.peers.get());
        cluster.is_none_or(|(owners, _)| {
            let compared = hosted.peer_comparison.compared.load(Relaxed);
            compared == changes(&**owners, hosted) && hosted.contradiction().is_none()
        })
    }
}

/// The number of changes after which the records have to be compared. Both parts only grow, so that the sum is the same only if
/// both are.
fn changes(owners: &dyn Owners, hosted: &Hosted) -> u64 {
    owners.changes() + hosted.peer_comparison.resumptions.load(Relaxed)
}

/// Compares the records of an index with those of the members, unless another call has meanwhile.
async fn compare_in_turn(
    owners: Arc<dyn Owners>,
    peers: Arc<dyn Peers>,
    hosted: Arc<Hosted>,
) -> Result<(), Error> {
    let began = Instant::now();
    let peer_comparison = &hosted.peer_comparison;
    let mut turn = peer_comparison.turn.lock().await;
    peers.wait_for_members().await;
    // Read before the members are: one that joins meanwhile is asked by the next mutation.
    let changes = changes(&*owners, &hosted);
    if peer_comparison.compared.load(Relaxed) == changes {
        return Ok(());
    }
    // Calls that waited for their turn do not wait for the same again.
    if let Some(failed) = turn.as_ref().filter(|failed| failed.at > began) {
        let what = failed.what.clone();
        return Err(match failed.is_loss {
            true => Error::DataLoss { what },
            false => Error::StorageFailed { what },
        });
    }
    if let Err(error) = compare(&*peers, &hosted).await {
        *turn = Some(ComparisonFailure {
            at: Instant::now(),
            is_loss: matches!(error, Error::DataLoss { .. }),
            what: error.to_string(),
        });
        return Err(error);
    }
    peer_comparison.compared.store(changes, Relaxed);
    Ok(())
}

/// Compares the records of an index with those of all members that answer.
async fn compare(peers: &dyn Peers, hosted: &Arc<Hosted>) -> Result<(), Error> {
    let own = hosted.published().view.position();
    let members = peers.peers(hosted.uid());
    let asking = members.iter().map(|member| ask(peers, member, hosted, own));
    let answers = join_all(asking).await;
    for (member, answer) in members.iter().zip(&answers) {
        let Some((applied, requested)) = answer else {
            continue;
        };
        let is_other = |requested: &RecordPosition| {
            requested.revision == own.revision && requested.digest != own.digest
        };
        if requested.as_ref().is_some_and(is_other) {
            return Err(report_contradiction(hosted, member, own.revision).await);
        }
        if applied.revision > own.revision {
            let arrival = timeout(ARRIVAL_TIME, hosted.reached(applied.revision)).await;
            let arrived = arrival.map_err(|_| behind(hosted, member, *applied))?;
            arrived.map_err(|error| registry_error(hosted.name(), error))?;
        }
        let digest = digest_at(hosted, applied.revision).await?;
        if digest.is_some_and(|digest| digest != applied.digest) {
            return Err(report_contradiction(hosted, member, applied.revision).await);
        }
    }
    Ok(())
}

/// The newest record that a member has applied, and the one that it has applied in the place of `own`, if it keeps that; None
/// if it does not answer, or does not have the index.
async fn ask(
    peers: &dyn Peers,
    member: &str,
    hosted: &Hosted,
    own: RecordPosition,
) -> Option<(RecordPosition, Option<RecordPosition>)> {
    let request = StoredRequest {
        uids: vec![hosted.uid_text().into()],
        revisions: vec![own.revision],
    };
    let answer = match timeout(ANSWER_TIME, peers.stored(member, request)).await {
        Ok(Ok(answer)) => answer,
        Ok(Err(error)) => {
            debug!(index = hosted.name(), member, %error, "a server is not compared");
            return None;
        }
        Err(_) => {
            debug!(
                index = hosted.name(),
                member, "a server is not compared: no answer in time"
            );
            return None;
        }
    };
    let is_it = |index: &StoredIndex| index.uid == hosted.uid_text();
    let index = answer.indexes.into_iter().find(is_it)?;
    let requested = index.requested.and_then(|requested| requested.position());
    Some((index.applied?.position()?, requested))
}

/// The digest of this server's record of a revision, if it keeps that.
async fn digest_at(hosted: &Arc<Hosted>, revision: u64) -> Result<Option<Digest>, Error> {
    let reading = Arc::clone(hosted);
    let read = tokio::task::spawn_blocking(move || reading.digest_at(revision)).await;
    let read = read.map_err(|_| Error::Internal {
        what: "the task that reads a record panicked".into(),
    })?;
    read.map_err(|error| registry_error(hosted.name(), error))
}

/// Tells all servers that `member` has applied another record of this revision, and returns the error of the mutation.
async fn report_contradiction(hosted: &Arc<Hosted>, member: &str, revision: u64) -> Error {
    let (noting, member) = (Arc::clone(hosted), member.to_owned());
    let noted =
        tokio::task::spawn_blocking(move || noting.report_contradiction(revision, &member)).await;
    noted.map_or_else(
        |_| Error::Internal {
            what: "the task that notes a contradiction panicked".into(),
        },
        |why| registry_error(hosted.name(), why),
    )
}

/// The error of a mutation while a member has records that this server lacks.
fn behind(hosted: &Hosted, member: &str, applied: RecordPosition) -> Error {
    let (index, revision) = (hosted.name(), applied.revision);
    let own_revision = hosted.published().revision;
    Error::StorageFailed {
        what: format!(
            "index \"{index}\": {member} has applied the records up to revision {revision}, and this server has those up to \
             {own_revision}: if NATS has lost the rest, that server publishes them again; nothing was changed, so call again"
        ),
    }
}

#[cfg(test)]
mod tests;
