//! Heals the indices of this server that cannot follow their journal: another member of the cluster gives a copy, which takes
//! the place of the index, and the journal is followed from there on.
//!
//! A copy is taken only if no reader goes backwards, if the member has applied the same records as this server as far as
//! both know them, and if the journal has the newest record of the copy.

mod draft;

use std::{
    collections::{HashMap, HashSet, VecDeque},
    sync::Arc,
    time::Duration,
};

use futures_util::StreamExt;
use tokio::{
    sync::oneshot,
    time::{Instant, MissedTickBehavior, interval, timeout},
};
use tracing::{debug, warn};

use self::draft::CopyDraft;
use super::{
    Service,
    member::{CopyKind, CopyParts, CopyRequest, Peers},
};
use crate::{
    log::{LogError, Uid},
    registry::{Registry, Stopped},
};

/// The time between two checks of the indices.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// An index that may go on by itself has this long.
const GRACE: Duration = Duration::from_secs(5);

/// The longest wait before the members are asked again for a copy of an index, unless the last attempt took longer.
const MAX_WAIT: Duration = Duration::from_secs(15);

/// A member that sends no part of a copy for this long does not answer.
const PART_TIME: Duration = Duration::from_secs(10);

/// The attempts to heal an index.
struct Attempts {
    next: Instant,
    wait: Duration,
    /// The failure of the last one.
    why: String,
}

impl Attempts {
    /// The first one is after this time.
    fn starting(after: Duration) -> Self {
        Self {
            next: Instant::now() + after,
            wait: CHECK_INTERVAL,
            why: String::new(),
        }
    }

    /// Notes that one failed after `took`. The next one waits for at least as long: a large copy that breaks off again and
    /// again is under way for at most half of the time.
    fn failed(&mut self, why: String, took: Duration) {
        self.wait = (2 * self.wait).min(MAX_WAIT);
        self.next = Instant::now() + self.wait.max(took);
        self.why = why;
    }
}

/// A member gave no copy.
enum Failure {
    /// It has applied another record of this revision.
    Contradicts(u64),
    /// It does not know the newest record of this server.
    NotCompared,
    /// Another reason.
    Other(String),
}

impl<E: std::error::Error> From<E> for Failure {
    fn from(error: E) -> Self {
        Self::Other(error.to_string())
    }
}

impl Service {
    /// Heals the indices that stop, until it is dropped. Answers `tried` once it has tried to heal those that have stopped
    /// already.
    pub(crate) async fn heal(self, peers: Arc<dyn Peers>, tried: oneshot::Sender<()>) {
        let mut ticks = interval(CHECK_INTERVAL);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        ticks.tick().await;
        let mut attempts = HashMap::new();
        if self.has_stopped() {
            peers.wait_for_members().await;
            self.heal_stopped(&*peers, &mut attempts).await;
        }
        // The server may have given up waiting.
        let _ = tried.send(());
        loop {
            ticks.tick().await;
            self.heal_stopped(&*peers, &mut attempts).await;
        }
    }

    fn has_stopped(&self) -> bool {
        let registry = self.registry();
        registry.is_ok_and(|registry| !registry.stopped().is_empty())
    }

    /// Tries to heal each index whose time has come.
    async fn heal_stopped(&self, peers: &dyn Peers, attempts: &mut HashMap<Uid, Attempts>) {
        let Ok(registry) = self.registry() else {
            return;
        };
        let stopped = registry.stopped();
        let uids: HashSet<Uid> = stopped.iter().map(|it| it.uid).collect();
        attempts.retain(|uid, _| uids.contains(uid));
        for index in stopped {
            let after = match index.may_pass {
                true => GRACE,
                false => Duration::ZERO,
            };
            let start = || Attempts::starting(after);
            let attempt = attempts.entry(index.uid).or_insert_with(start);
            if attempt.next > Instant::now() {
                continue;
            }
            let began = Instant::now();
            if let Err(why) = heal_index(registry, self, peers, &index).await {
                let (index, uid) = (&index.name, index.uid);
                // It may last for days: log it only when it changes.
                match attempt.why == why {
                    true => debug!(index, %uid, why, "no member gives a copy of an index"),
                    false => {
                        warn!(index, %uid, why, "no member gives a copy of an index yet; trying again");
                    }
                }
                attempt.failed(why, began.elapsed());
            }
        }
    }
}

/// Asks one member after the other for a copy of an index. The error says why none gave one.
async fn heal_index(
    registry: &Arc<Registry>,
    service: &Service,
    peers: &dyn Peers,
    index: &Stopped,
) -> Result<(), String> {
    let mut min_revision = index.min_revision;
    if index.position.is_none() {
        // The revision that its readers saw is unknown. They cannot have seen more than the journal has.
        let newest = blocking(
            registry,
            |registry, uid| registry.journal_newest(uid),
            index.uid,
        )
        .await;
        match newest {
            Ok(newest) => min_revision = min_revision.max(newest),
            Err(Failure::Other(why)) => return Err(why),
            Err(Failure::Contradicts(_) | Failure::NotCompared) => {}
        }
    }
    let request = CopyRequest {
        uid: index.uid.to_string(),
        applied: index.position.map(Into::into),
        min_revision,
    };
    let mut failures = Vec::new();
    let is_comparable = index.position.is_some();
    let members = peers.peers(index.uid).into_iter();
    let mut members: VecDeque<_> = members.map(|member| (member, is_comparable)).collect();
    while let Some((member, must_compare)) = members.pop_front() {
        let copied = copy_from(
            registry,
            service,
            peers,
            &member,
            index,
            &request,
            must_compare,
        );
        match copied.await {
            Ok((revision, compared)) => {
                warn!(
                    index = index.name,
                    uid = %index.uid,
                    member,
                    revision,
                    compared,
                    "an index that could not follow its journal goes on from a copy of another server"
                );
                return Ok(());
            }
            Err(Failure::Contradicts(revision)) => {
                let by = member.clone();
                let close = move |registry: &Registry, uid: Uid| {
                    registry.close_contradicted(uid, revision, &by);
                    Ok(())
                };
                // The task only closes the index: its result is always Ok.
                let _ = blocking(registry, close, index.uid).await;
                return Err(format!(
                    "{member} has another record of revision {revision}"
                ));
            }
            // The others speak first: they may contradict.
            Err(Failure::NotCompared) => members.push_back((member, false)),
            Err(Failure::Other(why)) => failures.push(format!("{member}: {why}")),
        }
    }
    if failures.is_empty() {
        failures.push("there is no other live member".into());
    }
    Err(failures.join("; "))
}

/// Takes a copy of a member in the place of an index. Returns its revision; the flag is true if the member
/// has compared its records with the newest of this server. With `must_compare` no such copy is taken.
async fn copy_from(
    registry: &Arc<Registry>,
    service: &Service,
    peers: &dyn Peers,
    member: &str,
    index: &Stopped,
    request: &CopyRequest,
    must_compare: bool,
) -> Result<(u64, bool), Failure> {
    let answer = timeout(PART_TIME, peers.copy(member, request.clone()));
    let mut parts = answer.await??;
    let start = match next(&mut parts).await? {
        CopyKind::Start(start) => start,
        CopyKind::Contradicts(revision) => return Err(Failure::Contradicts(revision)),
        CopyKind::Refused(why) => return Err(Failure::Other(why)),
        CopyKind::Snapshot(_) | CopyKind::Operations(_) => return Err(out_of_order()),
    };
    let position = start.position.as_ref().and_then(|place| place.position());
    let position = position.ok_or_else(out_of_order)?;
    if position.revision < request.min_revision {
        let revision = position.revision;
        return Err(Failure::Other(format!(
            "its copy is of revision {revision}"
        )));
    }
    if must_compare && !start.is_compared {
        return Err(Failure::NotCompared);
    }
    let in_journal = move |registry: &Registry, uid| registry.is_in_journal(uid, position);
    if !blocking(registry, in_journal, index.uid).await? {
        let revision = position.revision;
        return Err(Failure::Other(format!(
            "the journal does not have its record of revision {revision}"
        )));
    }
    let mut draft = CopyDraft::new(service, index, position);
    while !draft.is_whole(start.operations) {
        let part = next(&mut parts).await?;
        let read = tokio::task::spawn_blocking(move || draft.read(part).map(|()| draft));
        draft = read.await??;
    }
    tokio::task::spawn_blocking(move || draft.host()).await??;
    Ok((position.revision, start.is_compared))
}

/// The next part of a copy.
async fn next(parts: &mut CopyParts) -> Result<CopyKind, Failure> {
    let part = timeout(PART_TIME, parts.next()).await?;
    let part = part.ok_or_else(|| Failure::Other("its copy is cut short".into()))??;
    part.kind.ok_or_else(out_of_order)
}

/// Asks the log through the registry on a thread that may block.
async fn blocking<T: Send + 'static>(
    registry: &Arc<Registry>,
    ask: impl FnOnce(&Registry, Uid) -> Result<T, LogError> + Send + 'static,
    uid: Uid,
) -> Result<T, Failure> {
    let registry = Arc::clone(registry);
    let answer = tokio::task::spawn_blocking(move || ask(&registry, uid));
    Ok(answer.await??)
}

fn out_of_order() -> Failure {
    Failure::Other("a part of its copy is not the one that belongs there".into())
}

#[cfg(test)]
mod tests;
