//! The places of connections, and the choice of the one that makes room for another.
//!
//! A client that only holds connections cannot lock others out: once all places are taken, a new connection gets the
//! place of one without a call under way. Connections that never made a call go first, then those whose last call is
//! the longest ago. If all others have calls, the one that has been silent for the longest time goes, such as one with an
//! idle stream. If none is silent either, one of the network that has the most connections goes after a while. A new one of
//! that network is a guest until a place is free: it may ask for health and make short calls of administration. A client
//! reconnects at its next call. Health and reflection are no calls of this kind.

use std::{
    cmp::Reverse,
    collections::HashMap,
    net::{IpAddr, SocketAddr},
    sync::{Arc, atomic::Ordering::SeqCst},
    time::Duration,
};

use parking_lot::Mutex;
use tokio::{
    sync::{OwnedSemaphorePermit, Semaphore},
    time::{Instant, timeout},
};
use tracing::debug;

use super::{Activity, Connections, GIVEN_UP, State};

/// A connection keeps its place for this long after it was opened and after a call: its client may be about to call,
/// and the end of an answer is about to leave. A guest keeps its place for this long.
pub(super) const MIN_IDLE: Duration = Duration::from_millis(100);

/// A connection with calls keeps its place for this long after its last sign of life: the beginning or end of a call, a
/// part of a request that arrived, a part of an answer that left.
pub(super) const MAX_SILENCE: Duration = Duration::from_secs(10);

/// A new connection waits for this long for one of those above. Then it gets a place of the network that has the most.
pub(in crate::grpc) const MAX_WAIT: Duration = Duration::from_secs(1);

/// The most guests.
pub(super) const MAX_GUESTS: usize = 32;

/// The places of a listener.
#[derive(Debug)]
pub(super) struct Places {
    all: Arc<Semaphore>,
    of_guests: Arc<Semaphore>,
    limit: usize,
    /// The time since which new connections have found no room.
    full_since: Mutex<Option<Instant>>,
}

/// The place of a connection, until it is dropped.
#[derive(Debug)]
pub(super) struct Place {
    _permit: OwnedSemaphorePermit,
    /// None for a lasting place.
    guest_since: Option<Instant>,
}

impl Places {
    /// Room for `limit` connections, and some guests.
    pub(super) fn new(limit: usize) -> Self {
        let limit = limit.min(Semaphore::MAX_PERMITS);
        Self {
            all: Arc::new(Semaphore::new(limit)),
            of_guests: Arc::new(Semaphore::new(MAX_GUESTS)),
            limit,
            full_since: Mutex::default(),
        }
    }

    fn take(&self) -> Option<Place> {
        let permit = Arc::clone(&self.all).try_acquire_owned().ok()?;
        Some(Place {
            _permit: permit,
            guest_since: None,
        })
    }

    /// The time since which there was no room. The listener takes one connection after another, so the wait of the first
    /// one counts for those behind it, for as long again.
    fn full_since(&self) -> Instant {
        let mut since = self.full_since.lock();
        since.take_if(|since| since.elapsed() >= 2 * MAX_WAIT);
        *since.get_or_insert_with(Instant::now)
    }
}

impl Connections {
    /// Waits for a place. None if there is not even that of a guest.
    pub(super) async fn place(&self, peer: Option<SocketAddr>) -> Option<Place> {
        let (places, newcomer) = (&self.places, peer.map(network));
        loop {
            if let Some(place) = places.take() {
                *places.full_since.lock() = None;
                return Some(place);
            }
            let full_since = places.full_since();
            if self.give_one_up() {
                *places.full_since.lock() = None;
            } else if full_since.elapsed() >= MAX_WAIT {
                if !self.give_up_of_many(newcomer) {
                    return self.place_of_guest().await;
                }
                *places.full_since.lock() = None;
            }
            // The place of the connection that was given up, or of another that ends. If none ends in time, the next one
            // is given up.
            let _ = timeout(MIN_IDLE, places.all.acquire()).await;
        }
    }

    /// The place of a guest: that of the first one if there is no other. None while all have just come.
    async fn place_of_guest(&self) -> Option<Place> {
        let of_guests = &self.places.of_guests;
        if of_guests.available_permits() == 0 {
            let open = self.open.lock();
            let mut open = open.values().filter(|state| !state.cut.is_cancelled());
            let first = open.find_map(|state| Some((state, state.guest_since()?)));
            let (state, _) = first.filter(|(_, since)| since.elapsed() >= MIN_IDLE)?;
            debug!(peer = ?state.peer, "a guest makes room for another");
            state.cut.cancel();
        }
        let permit = timeout(MIN_IDLE, Arc::clone(of_guests).acquire_owned()).await;
        Some(Place {
            _permit: permit.ok()?.ok()?,
            guest_since: Some(Instant::now()),
        })
    }

    /// Gives up the first connection without calls or, if that was opened or called just now, the one with calls that is
    /// silent for the longest time. False if there is none.
    fn give_one_up(&self) -> bool {
        let open = self.open.lock();
        let lasting = || open.values().filter(|state| state.guest_since().is_none());
        let idle = lasting()
            .filter(|state| state.calls.load(SeqCst) == 0 && !state.is_stalled.load(SeqCst));
        let first = idle.min_by_key(|state| state.rank.load(SeqCst));
        // A younger one is waited for: one that has called does not leave in its place.
        let idle = first.filter(|state| {
            state.silence() >= MIN_IDLE
                && (state.calls)
                    .compare_exchange(0, GIVEN_UP, SeqCst, SeqCst)
                    .is_ok()
        });
        let given_up = idle.or_else(|| {
            let open = lasting().filter(|state| !state.cut.is_cancelled());
            let silent = open.min_by_key(|state| *state.active_at.lock());
            silent.filter(|state| state.silence() >= MAX_SILENCE)
        });
        if let Some(state) = given_up {
            debug!(peer = ?state.peer, "an idle or silent connection makes room for another");
            state.cut.cancel();
        }
        given_up.is_some()
    }

    /// True if a connection that was given up still has its place.
    fn is_one_leaving(&self) -> bool {
        let open = self.open.lock();
        let mut lasting = open.values().filter(|state| state.guest_since().is_none());
        lasting.any(|state| state.cut.is_cancelled())
    }

    /// Gives up a connection of the network that has the most, two at least: the one whose last call is the longest ago.
    /// False if there is none, or that is the network of the `newcomer`.
    fn give_up_of_many(&self, newcomer: Option<IpAddr>) -> bool {
        let open = self.open.lock();
        let mut networks: HashMap<IpAddr, (usize, Reverse<u64>, &State)> = HashMap::new();
        for state in open.values() {
            if state.cut.is_cancelled() || state.guest_since().is_some() {
                continue;
            }
            let Some(peer) = state.peer else { continue };
            let rank = Reverse(state.rank.load(SeqCst));
            let (count, first, of) = networks.entry(network(peer)).or_insert((0, rank, state));
            *count += 1;
            if rank > *first {
                (*first, *of) = (rank, state);
            }
        }
        let most = networks
            .into_iter()
            .max_by_key(|(_, (count, first, _))| (*count, *first));
        let most = most.filter(|(network, (count, ..))| *count > 1 && newcomer != Some(*network));
        if let Some((_, (_, _, state))) = most {
            debug!(peer = ?state.peer, "a connection of the network that has the most makes room for another");
            state.cut.cancel();
        }
        most.is_some()
    }
}

impl State {
    /// The time at which it became a guest; None if it has a lasting place.
    fn guest_since(&self) -> Option<Instant> {
        self.place.lock().as_ref()?.guest_since
    }
}

impl Activity {
    /// Checks that it may make all calls: a guest gets a lasting place if one is free, and otherwise another connection may
    /// give up its own for the next call. Fails with the number of places.
    pub(in crate::grpc) fn check_place(&self) -> Result<(), usize> {
        if self.state.guest_since().is_none() {
            return Ok(());
        }
        let connections = &self.connections;
        let Some(place) = connections.places.take() else {
            if !connections.is_one_leaving() {
                connections.give_one_up();
            }
            return Err(connections.places.limit);
        };
        // None if the connection has ended meanwhile.
        if let Some(held) = &mut *self.state.place.lock() {
            *held = place;
        }
        Ok(())
    }
}

/// The network of a client: its address of IPv4, or the upper half of one of IPv6, since it may use all with that.
fn network(peer: SocketAddr) -> IpAddr {
    match peer.ip().to_canonical() {
        IpAddr::V6(address) => IpAddr::V6((address.to_bits() >> 64 << 64).into()),
        address => address,
    }
}
