//! The live members. Each announces its address over NATS every half second, and counts as gone after two seconds of
//! silence. A member hears its own announcements too. Without them it is cut off: it says so, owns no index for the others, and evaluates
//! itself what reaches it. Nothing of this is stored. NATS decides between two owners; but a live member that is not known is
//! not asked what it has applied, so a member that has just begun to hear waits before it trusts its list ([`Members::wait_for_members`]).

use std::{
    cmp::Reverse,
    collections::BTreeMap,
    sync::{
        Arc, OnceLock,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
    time::{Duration, Instant},
};

use async_nats::{Client, Message, connection::State};
use futures_util::{StreamExt, stream};
use parking_lot::Mutex;
use serde::{Deserialize, Serialize};
use tokio::{
    sync::{broadcast, watch},
    time::{MissedTickBehavior, interval, timeout},
};
use tokio_util::task::AbortOnDropHandle;
use tracing::{debug, info, warn};
use xxhash_rust::xxh3::xxh3_64;

use crate::log::Uid;

/// The time between two announcements.
const INTERVAL: Duration = Duration::from_millis(500);

/// A member that has heard itself for this long has heard an announcement of every live member.
const HEARING_TIME: Duration = Duration::from_millis(1000);

/// A member that does not hear itself for this long goes on alone.
const MAX_HEARING_TIME: Duration = Duration::from_secs(5);

/// A member that has not announced itself for this long is gone.
const LEASE: Duration = Duration::from_secs(2);

/// The members that may become silent at once before a call that waits for an answer hears of it.
const MAX_SILENT: usize = 64;

/// A member's announcement.
#[derive(Debug, Serialize, Deserialize)]
struct Announcement {
    /// The address at which it is reached.
    address: String,
    /// A name of its run.
    run: String,
    /// False if it is about to stop, has not started yet, does not hear NATS, or cannot read its store.
    serves: bool,
}

/// The members that are heard, this one among them, by address, with the time of their last announcement.
type Live = BTreeMap<String, Instant>;

/// See the module.
pub(super) struct Members {
    nats: Client,
    subject: String,
    address: String,
    run: String,
    shared: Arc<Shared>,
    following: Mutex<Option<AbortOnDropHandle<()>>>,
}

/// What the task that follows the members notes.
struct Shared {
    live: watch::Sender<Live>,
    /// The members that have become silent.
    silent: broadcast::Sender<String>,
    /// True if all live members have been heard.
    hears_all: watch::Sender<bool>,
    /// The number of times that they changed, from 1 on.
    changes: AtomicU64,
    /// False while another server answers better; unset until the server serves.
    fitness: OnceLock<watch::Receiver<bool>>,
}

impl Shared {
    fn new() -> Self {
        Self {
            live: watch::Sender::default(),
            silent: broadcast::Sender::new(MAX_SILENT),
            hears_all: watch::Sender::new(false),
            changes: AtomicU64::new(1),
            fitness: OnceLock::new(),
        }
    }

    /// True if the others may call this server, whose address is `address`.
    fn serves(&self, address: &str) -> bool {
        let is_fit = self.fitness.get().is_some_and(|fitness| *fitness.borrow());
        is_fit && self.live.borrow().contains_key(address)
    }
}

impl Members {
    /// Follows the others as the server at `address`, which is no live member before [`Members::serve`].
    pub(super) fn join(nats: Client, subject: String, address: String) -> Self {
        let run = Uid::unique().to_string();
        let shared = Arc::new(Shared::new());
        let following = follow(
            nats.clone(),
            subject.clone(),
            (address.clone(), run.clone()),
            Arc::clone(&shared),
        );
        Self {
            nats,
            subject,
            address,
            run,
            shared,
            following: Mutex::new(Some(AbortOnDropHandle::new(tokio::spawn(following)))),
        }
    }

    /// Announces from now on that the server takes calls of the others, while `fitness` is true.
    pub(super) fn serve(&self, fitness: watch::Receiver<bool>) {
        // A second call changes nothing.
        let _ = self.shared.fitness.set(fitness);
    }

    /// Announces that the server leaves, and announces it no more.
    pub(super) async fn leave(&self) {
        drop(self.following.lock().take());
        let last = Announcement {
            address: self.address.clone(),
            run: self.run.clone(),
            serves: false,
        };
        announce(&self.nats, &self.subject, &last).await;
        // A member that does not hear it notices its silence.
        let _ = timeout(INTERVAL, self.nats.flush()).await;
    }

    /// The member that owns an index; None if it is this server, or if this server is cut off.
    pub(super) fn owner(&self, uid: Uid) -> Option<String> {
        let live = self.shared.live.borrow();
        live.get(&self.address)?;
        let owner = live.keys().max_by_key(|address| weight(address, uid))?;
        (*owner != self.address).then(|| owner.clone())
    }

    /// The other live members; at first the one that owns the index, or would without this server.
    pub(super) fn others(&self, uid: Uid) -> Vec<String> {
        let live = self.shared.live.borrow();
        let others = live.keys().filter(|address| **address != self.address);
        let mut others: Vec<String> = others.cloned().collect();
        others.sort_by_key(|address| Reverse(weight(address, uid)));
        others
    }

    /// The number of times that the live members changed, from 1 on.
    pub(super) fn changes(&self) -> u64 {
        self.shared.changes.load(Relaxed)
    }

    /// The number of live members, this one among them; 0 if it is cut off.
    pub(super) fn count(&self) -> usize {
        let live = self.shared.live.borrow();
        let is_heard = live.contains_key(&self.address);
        if is_heard { live.len() } else { 0 }
    }

    /// Waits until all live members have been heard, since the start or since this one was cut off.
    pub(super) async fn wait_for_members(&self) {
        let mut hears_all = self.shared.hears_all.subscribe();
        // NATS may forbid the subject of the announcements: the members are strangers to each other then.
        let _ = timeout(MAX_HEARING_TIME, hears_all.wait_for(|it| *it)).await;
    }

    /// Waits until a member is not heard any more. One that announces its leave still ends its calls.
    pub(super) async fn silence(&self, member: &str) {
        let mut silent = self.shared.silent.subscribe();
        // The sender lives as long as this.
        while silent.recv().await.as_deref() != Ok(member) {}
    }
}

/// The weight of a member for an index: the member with the greatest owns it. So only the indices of a member that comes or
/// goes change their owner.
fn weight(address: &str, uid: Uid) -> u64 {
    xxh3_64(&[uid.as_bytes(), address.as_bytes()].concat())
}

/// Announces a member, unless NATS cannot be reached.
async fn announce(nats: &Client, subject: &str, announcement: &Announcement) {
    let Ok(text) = serde_json::to_vec(announcement) else {
        return;
    };
    if nats.connection_state() != State::Connected {
        return;
    }
    let published = timeout(INTERVAL, nats.publish(subject.to_owned(), text.into())).await;
    if !matches!(published, Ok(Ok(()))) {
        debug!("cannot announce this server to the others now");
    }
}

/// Announces this server, and notes what it hears, until it is dropped.
async fn follow(
    nats: Client,
    subject: String,
    (address, run): (String, String),
    shared: Arc<Shared>,
) {
    let Shared {
        live,
        silent,
        hears_all,
        changes,
        fitness: _,
    } = &*shared;
    let mut hears_itself_since = None;
    let mut heard = match nats.subscribe(subject.clone()).await {
        Ok(heard) => heard.boxed(),
        Err(error) => {
            warn!(%error, "cannot hear of the other servers of the cluster");
            stream::pending().boxed()
        }
    };
    let mut own = Announcement {
        address,
        run,
        serves: false,
    };
    let mut ticks = interval(INTERVAL);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut is_warned = false;
    loop {
        tokio::select! {
            _ = ticks.tick() => {
                own.serves = shared.serves(&own.address);
                announce(&nats, &subject, &own).await;
            }
            Some(message) = heard.next() => {
                if let Some(member) = read(&message) {
                    let is_twin = member.address == own.address && member.run != own.run;
                    if is_twin && !std::mem::replace(&mut is_warned, true) {
                        warn!(
                            address = own.address,
                            "another server of the cluster has the same address: give each its own with \
                             cluster.advertise"
                        );
                    }
                    let is_own = member.run == own.run;
                    if (is_own || !is_twin) && note(live, member, is_own) {
                        changes.fetch_add(1, Relaxed);
                    }
                }
            }
        }
        let now = Instant::now();
        let expired = expire(live, now);
        if !expired.is_empty() {
            changes.fetch_add(1, Relaxed);
        }
        for member in expired {
            // Nobody may wait for it.
            let _ = silent.send(member);
        }
        hears_itself_since = match live.borrow().contains_key(&own.address) {
            true => hears_itself_since.or(Some(now)),
            false => None,
        };
        hears_all.send_if_modified(|known| {
            let is_so = hears_itself_since.is_some_and(|since| now - since >= HEARING_TIME);
            std::mem::replace(known, is_so) != is_so
        });
    }
}

fn read(message: &Message) -> Option<Announcement> {
    let read = serde_json::from_slice(&message.payload);
    read.inspect_err(|error| debug!(%error, "not an announcement of a server"))
        .ok()
}

/// Notes a member. One that does not serve is gone; this server serves once it hears itself. True if that changes the members.
fn note(live: &watch::Sender<Live>, member: Announcement, is_own: bool) -> bool {
    live.send_if_modified(|live| {
        if !member.serves && !is_own {
            let is_gone = live.remove(&member.address).is_some();
            if is_gone {
                info!(address = member.address, "a server leaves the cluster");
            }
            return is_gone;
        }
        let is_new = !live.contains_key(&member.address);
        if is_new && !is_own {
            info!(address = member.address, "a server joins the cluster");
        }
        live.insert(member.address, Instant::now());
        is_new
    })
}

/// Forgets the members that have been silent for too long, and returns them.
fn expire(live: &watch::Sender<Live>, now: Instant) -> Vec<String> {
    let mut expired = Vec::new();
    live.send_if_modified(|live| {
        live.retain(|address, heard| {
            let is_live = now.saturating_duration_since(*heard) < LEASE;
            if !is_live {
                info!(address, "a server of the cluster is not heard");
                expired.push(address.clone());
            }
            is_live
        });
        !expired.is_empty()
    });
    expired
}

#[cfg(test)]
mod tests {
    use super::*;

    fn owner<'a>(members: &[&'a str], uid: Uid) -> &'a str {
        let owner = members.iter().max_by_key(|member| weight(member, uid));
        owner.unwrap()
    }

    #[test]
    fn a_member_that_leaves_changes_only_the_owners_of_its_indices() {
        let (all, rest) = (["a:1", "b:1", "c:1"], ["a:1", "c:1"]);
        let mut owned = BTreeMap::<&str, usize>::new();
        for _ in 0..3000 {
            let uid = Uid::unique();
            let (before, after) = (owner(&all, uid), owner(&rest, uid));
            assert!(before == after || before == "b:1");
            *owned.entry(before).or_default() += 1;
        }
        for (member, indices) in owned {
            assert!((850..1150).contains(&indices), "{member}: {indices}");
        }
    }

    /// Its part of the indices would be forwarded to it, and it could answer none.
    #[test]
    fn a_member_that_cannot_read_its_store_does_not_serve() {
        let shared = Shared::new();
        shared.live.send_modify(|live| {
            live.insert("a:1".into(), Instant::now());
        });
        assert!(!shared.serves("a:1"), "it has not started");
        let is_fit = watch::Sender::new(false);
        shared.fitness.set(is_fit.subscribe()).unwrap();
        assert!(!shared.serves("a:1"));
        is_fit.send_replace(true);
        assert!(shared.serves("a:1"));
        assert!(!shared.serves("b:1"), "it does not hear itself");
    }

    #[test]
    fn a_silent_member_is_gone_and_one_that_leaves_at_once() {
        let live = watch::Sender::new(Live::new());
        let said = |address: &str, serves| Announcement {
            address: address.into(),
            run: String::new(),
            serves,
        };
        assert!(note(&live, said("a:1", true), false));
        assert!(note(&live, said("b:1", true), false));
        assert!(!note(&live, said("b:1", true), false));
        assert!(note(&live, said("b:1", false), false));
        assert_eq!(live.borrow().keys().collect::<Vec<_>>(), ["a:1"]);
        assert_eq!(expire(&live, Instant::now()), [""; 0]);
        assert_eq!(live.borrow().len(), 1);
        assert_eq!(expire(&live, Instant::now() + LEASE), ["a:1"]);
        assert!(live.borrow().is_empty());
    }
}
