//! Trims the journal that the members of a cluster share. The owner of an index asks all live members which revision they
//! store, and forgets the records that all of them have and that are outside the window.
//!
//! A record is forgotten only once two members at least store its effects so that they survive a loss of power. A member that
//! was away for longer takes a copy of another (`heal`).

use std::{
    collections::{BTreeSet, HashMap},
    sync::Arc,
    time::Duration,
};

use tokio::time::{MissedTickBehavior, interval, timeout};
use tracing::{debug, warn};

use super::{
    Error, Owners, Peers, Service,
    member::{StoredIndex, StoredRequest, StoredResponse},
};
use crate::{
    log::Uid,
    registry::{Hosted, Registry, Stored},
};

/// The members that store a record durably before it is forgotten.
const MIN_STORES: usize = 2;

/// The time in which a member answers.
const ANSWER_TIME: Duration = Duration::from_secs(10);

/// The most indices in a request.
const MAX_INDEXES: usize = 1000;

impl Service {
    /// Trims the journal from time to time, until it is dropped.
    pub(crate) async fn trim_journal(self, owners: Arc<dyn Owners>, peers: Arc<dyn Peers>) {
        let Ok(registry) = self.registry() else {
            return;
        };
        let mut ticks = interval(registry.trim_interval());
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            if owners.members() < MIN_STORES {
                debug!("no other server is live, so the journal is not trimmed");
                continue;
            }
            let mut owned = registry.following();
            owned.retain(|hosted| owners.owner(hosted.uid()).is_none());
            for indexes in owned.chunks(MAX_INDEXES) {
                if let Err(why) = trim(registry, &*peers, indexes).await {
                    debug!(why, "the journal is not trimmed now");
                }
            }
        }
    }

    /// What this server stores of some indices.
    pub(crate) fn stored(&self, request: StoredRequest) -> Result<StoredResponse, Error> {
        let uids: BTreeSet<Uid> = request
            .uids
            .iter()
            .filter_map(|it| it.parse().ok())
            .collect();
        let stored = self.registry()?.stored(&uids);
        let stored = stored.into_iter().map(|(uid, stored)| StoredIndex {
            uid: uid.to_string(),
            revision: stored.revision,
            is_durable: stored.is_durable,
        });
        Ok(StoredResponse {
            indexes: stored.collect(),
        })
    }
}

/// Trims the journal of these indices. The error says which member did not answer.
async fn trim(
    registry: &Arc<Registry>,
    peers: &dyn Peers,
    indexes: &[Arc<Hosted>],
) -> Result<(), String> {
    let uids: BTreeSet<Uid> = indexes.iter().map(|hosted| hosted.uid()).collect();
    let mut stores = vec![registry.stored(&uids)];
    for member in peers.all() {
        let request = StoredRequest {
            uids: uids.iter().map(Uid::to_string).collect(),
        };
        let answer = timeout(ANSWER_TIME, peers.stored(&member, request)).await;
        let answer = answer.map_err(|_| format!("{member} does not answer in time"))?;
        stores.push(read(answer.map_err(|error| format!("{member}: {error}"))?));
    }
    for hosted in indexes {
        let Some(up_to) = stored_by_all(&stores, hosted.uid()) else {
            continue;
        };
        let forgetting = Arc::clone(hosted);
        let forgotten = tokio::task::spawn_blocking(move || forgetting.forget(up_to)).await;
        // The join fails only if the task panicked; the panic hook has printed it.
        if let Ok(Err(error)) = forgotten {
            warn!(index = hosted.name(), %error, "cannot trim the journal");
        }
    }
    Ok(())
}

/// What a member stores. An index whose uid does not parse counts as missing.
fn read(answer: StoredResponse) -> HashMap<Uid, Stored> {
    let read = answer.indexes.into_iter().filter_map(|index| {
        let stored = Stored {
            revision: index.revision,
            is_durable: index.is_durable,
        };
        Some((index.uid.parse().ok()?, stored))
    });
    read.collect()
}

/// The revision of an index that each of the members stores; None if one does not, or if too few store it durably.
fn stored_by_all(stores: &[HashMap<Uid, Stored>], uid: Uid) -> Option<u64> {
    let stored: Option<Vec<&Stored>> = stores.iter().map(|store| store.get(&uid)).collect();
    let stored = stored?;
    let durable = stored.iter().filter(|stored| stored.is_durable);
    if durable.count() < MIN_STORES {
        return None;
    }
    stored.iter().map(|stored| stored.revision).min()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_revision_of_all_counts_if_two_store_it_durably() {
        let uid = Uid::unique();
        let of = |members: &[Option<(u64, bool)>]| {
            let stores = members.iter().map(|member| {
                let stored = member.map(|(revision, is_durable)| Stored {
                    revision,
                    is_durable,
                });
                stored.map(|stored| (uid, stored)).into_iter().collect()
            });
            stored_by_all(&stores.collect::<Vec<_>>(), uid)
        };
        let (disk, memory) = (
            |revision| Some((revision, true)),
            |revision| Some((revision, false)),
        );
        assert_eq!(of(&[disk(7), disk(5)]), Some(5));
        assert_eq!(of(&[disk(7), disk(9), memory(3)]), Some(3));
        assert_eq!(of(&[disk(7)]), None);
        assert_eq!(of(&[disk(7), memory(7)]), None);
        assert_eq!(of(&[disk(7), disk(7), None]), None);
        assert_eq!(of(&[]), None);
    }
}
