//! Trims the journal that the members of a cluster share. The owner of an index asks all live members which revision they
//! store, and forgets the records that all of them have and that are outside the window.
//!
//! A record is forgotten only once two members at least store its effects so that they survive a loss of power. A member that
//! was away for longer takes a copy of another (`heal`).

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    iter::repeat,
    sync::Arc,
    time::Duration,
};

use tokio::time::{MissedTickBehavior, interval, timeout};
use tracing::{debug, warn};

use super::{
    Error, Owners, Peers, Service,
    member::{StoredIndex, StoredRequest, StoredResponse},
};
use crate::{log::Uid, registry::Hosted};

/// The members that store a record durably before it is forgotten.
const MIN_STORES: usize = 2;

/// The time in which a member answers.
const ANSWER_TIME: Duration = Duration::from_secs(10);

/// The most indices in a request.
const MAX_INDEXES: usize = 1000;

/// The member that holds back the trimming of an index.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Holder {
    /// Its address, or a description.
    member: String,
    /// The newest revision outside of all windows when it was found.
    outside: u64,
    /// True once it was logged.
    is_warned: bool,
}

/// The part of a journal that may be forgotten.
#[derive(Debug, PartialEq, Eq)]
struct Bounds {
    /// The newest revision that may be forgotten; None if none may.
    up_to: Option<u64>,
    /// The newest revision outside of the windows of all members that answered.
    outside: u64,
    /// The member by which the first is less than the second.
    held_by: Option<String>,
}

/// The name of this server among the members.
const OWN: &str = "this server";

impl Service {
    /// Trims the journal from time to time, until it is dropped.
    pub(crate) async fn trim_journal(self, owners: Arc<dyn Owners>, peers: Arc<dyn Peers>) {
        let Ok(registry) = self.registry() else {
            return;
        };
        let mut ticks = interval(registry.trim_interval());
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut holders = HashMap::new();
        loop {
            ticks.tick().await;
            let members = owners.members();
            if members < MIN_STORES {
                debug!("no other server is live, so the journal is not trimmed");
            }
            let (owned, others): (Vec<_>, Vec<_>) = registry
                .following()
                .into_iter()
                .partition(|hosted| members > 0 && owners.owner(hosted.uid()).is_none());
            others.iter().for_each(|hosted| hosted.count_none_held());
            let uids: BTreeSet<Uid> = owned.iter().map(|hosted| hosted.uid()).collect();
            holders.retain(|uid, _| uids.contains(uid));
            for indexes in owned.chunks(MAX_INDEXES) {
                trim(&self, &*peers, indexes, &mut holders).await;
            }
        }
    }

    /// The stored revisions of some indices of this server.
    pub(crate) async fn stored(&self, request: StoredRequest) -> Result<StoredResponse, Error> {
        let revisions = request.revisions.iter().copied().map(Some);
        let revisions = revisions.chain(repeat(None));
        let requested = request.uids.iter().zip(revisions);
        let requested = requested.filter_map(|(uid, revision)| Some((uid.parse().ok()?, revision)));
        let requested: BTreeMap<Uid, Option<u64>> = requested.collect();
        let registry = Arc::clone(self.registry()?);
        let stored = tokio::task::spawn_blocking(move || registry.stored(&requested)).await;
        // The join fails only if the task panicked; the panic hook has printed it.
        let stored = stored.unwrap_or_default().into_iter();
        let stored = stored.map(|(uid, stored)| StoredIndex {
            uid: uid.to_string(),
            revision: stored.revision,
            is_durable: stored.is_durable,
            oldest: stored.oldest,
            applied: Some(stored.applied.into()),
            requested: stored.requested.map(Into::into),
        });
        Ok(StoredResponse {
            indexes: stored.collect(),
        })
    }
}

/// Trims the journal of these indices.
async fn trim(
    service: &Service,
    peers: &dyn Peers,
    indexes: &[Arc<Hosted>],
    holders: &mut HashMap<Uid, Holder>,
) {
    let uids = indexes.iter().map(|hosted| hosted.uid().to_string());
    let request = StoredRequest {
        uids: uids.collect(),
        revisions: Vec::new(),
    };
    let own = service.stored(request.clone()).await;
    let mut stores = vec![(OWN.to_owned(), own.ok().map(read))];
    for member in peers.all() {
        let answer = timeout(ANSWER_TIME, peers.stored(&member, request.clone())).await;
        let store = match answer {
            Ok(Ok(answer)) => Some(read(answer)),
            Ok(Err(error)) => {
                debug!(member, %error, "the journal is not trimmed now");
                None
            }
            Err(_) => {
                debug!(member, "the journal is not trimmed now: no answer in time");
                None
            }
        };
        stores.push((member, store));
    }
    for hosted in indexes {
        let bounds = bounds(&stores, hosted.uid());
        let (trimming, up_to, outside) = (Arc::clone(hosted), bounds.up_to, bounds.outside);
        let is_held = bounds.held_by.is_some();
        let trimmed = tokio::task::spawn_blocking(move || {
            if let Some(up_to) = up_to {
                trimming.forget(up_to)?;
            }
            if is_held {
                return trimming.count_held(outside);
            }
            trimming.count_none_held();
            Ok(0)
        });
        // The join fails only if the task panicked; the panic hook has printed it.
        match trimmed.await {
            Ok(Ok(held)) => note_holder(hosted, bounds, held, holders),
            Ok(Err(error)) => warn!(index = hosted.name(), %error, "cannot trim the journal"),
            Err(_) => {}
        }
    }
}

/// Notes which member holds back the trimming of an index. It is logged once what was outside of all windows in the round
/// before is still held: until then the member may only be a little behind.
fn note_holder(hosted: &Hosted, bounds: Bounds, held: u64, holders: &mut HashMap<Uid, Holder>) {
    let Some(member) = bounds.held_by.filter(|_| held > 0) else {
        holders.remove(&hosted.uid());
        return;
    };
    let is_known =
        |holder: &&mut Holder| holder.member == member && bounds.up_to < Some(holder.outside);
    let Some(holder) = holders.get_mut(&hosted.uid()).filter(is_known) else {
        let holder = Holder {
            member,
            outside: bounds.outside,
            is_warned: false,
        };
        holders.insert(hosted.uid(), holder);
        return;
    };
    if !std::mem::replace(&mut holder.is_warned, true) {
        warn!(
            index = hosted.name(),
            uid = %hosted.uid(),
            member,
            held,
            "a server holds back the trimming of the journal in NATS"
        );
    }
}

/// The revisions that a member stores. An index whose uid does not parse counts as missing.
fn read(answer: StoredResponse) -> HashMap<Uid, StoredIndex> {
    let indexes = answer.indexes.into_iter();
    let read = indexes.filter_map(|stored| Some((stored.uid.parse().ok()?, stored)));
    read.collect()
}

/// The part of an index's journal that each of the members stores, two of them durably, and that no window has. A member
/// without an answer stores nothing.
fn bounds(stores: &[(String, Option<HashMap<Uid, StoredIndex>>)], uid: Uid) -> Bounds {
    let stored: Vec<(&String, Option<&StoredIndex>)> = stores
        .iter()
        .map(|(member, store)| (member, store.as_ref().and_then(|store| store.get(&uid))))
        .collect();
    let known = || stored.iter().filter_map(|(_, stored)| *stored);
    let before = |stored: &StoredIndex| stored.oldest.map(|oldest| oldest.saturating_sub(1));
    // A member whose window is empty asks for no record.
    let newest = known().map(|stored| stored.revision).max();
    let outside = known().filter_map(before).min().or(newest).unwrap_or(0);
    let held = |member: &str, up_to| Bounds {
        up_to,
        outside,
        held_by: Some(member.to_owned()),
    };
    if let Some((member, _)) = stored.iter().find(|(_, stored)| stored.is_none()) {
        return held(member, None);
    }
    if known().filter(|stored| stored.is_durable).count() < MIN_STORES {
        let volatile = stored
            .iter()
            .find(|(_, stored)| stored.is_some_and(|stored| !stored.is_durable));
        return match volatile {
            Some((member, _)) => held(member, None),
            None => held("no other live server", None),
        };
    }
    let least = stored
        .iter()
        .filter_map(|(member, stored)| Some((stored.as_ref()?.revision, member)))
        .min();
    match least {
        Some((revision, member)) if revision < outside => held(member, Some(revision)),
        _ => Bounds {
            up_to: Some(outside),
            outside,
            held_by: None,
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stored(revision: u64, is_durable: bool, oldest: Option<u64>) -> Option<StoredIndex> {
        Some(StoredIndex {
            revision,
            is_durable,
            oldest,
            ..Default::default()
        })
    }

    /// The bounds by what the members "0", "1" … store.
    fn of(members: &[Option<StoredIndex>]) -> (Option<u64>, u64, Option<String>) {
        let uid = Uid::unique();
        let stores = members.iter().enumerate().map(|(number, member)| {
            let store = member.clone().map(|stored| HashMap::from([(uid, stored)]));
            (number.to_string(), store)
        });
        let bounds = bounds(&stores.collect::<Vec<_>>(), uid);
        (bounds.up_to, bounds.outside, bounds.held_by)
    }

    #[test]
    fn the_least_revision_of_all_counts_if_two_store_it_durably() {
        let (disk, memory) = (
            |revision| stored(revision, true, None),
            |revision| stored(revision, false, None),
        );
        let by = |member: &str| Some(member.to_owned());
        assert_eq!(of(&[disk(7), disk(5)]), (Some(5), 7, by("1")));
        assert_eq!(of(&[disk(7), disk(9), memory(3)]), (Some(3), 9, by("2")));
        assert_eq!(of(&[disk(7)]), (None, 7, by("no other live server")));
        assert_eq!(of(&[disk(7), memory(7)]), (None, 7, by("1")));
        assert_eq!(of(&[disk(7), disk(7), None]), (None, 7, by("2")));
        assert_eq!(of(&[]), (None, 0, by("no other live server")));
    }

    #[test]
    fn the_windows_of_all_members_are_kept() {
        let with = |revision, oldest| stored(revision, true, oldest);
        assert_eq!(
            of(&[with(9, Some(8)), with(9, Some(4))]),
            (Some(3), 3, None)
        );
        // The window of a member is empty after a copy.
        assert_eq!(of(&[with(9, None), with(9, Some(4))]), (Some(3), 3, None));
        let held = Some("1".to_owned());
        assert_eq!(
            of(&[with(9, Some(8)), with(2, Some(1))]),
            (Some(0), 0, None)
        );
        assert_eq!(of(&[with(9, Some(8)), with(5, None)]), (Some(5), 7, held));
    }
}
