//! The open connections, and the choice of the one that makes room for another.
//!
//! A client that only holds connections cannot lock others out: once all places are taken, a new connection gets the
//! place of one without a call under way. Connections that never made a call go first, then those whose last call is
//! the longest ago. If all others have calls, the one that has been silent for the longest time goes, such as one with an
//! idle stream. If none is silent either, one of the network that has the most connections goes after a while, or the new
//! one if it is of that network. A client reconnects at its next call. Health and reflection are no calls of this kind.

mod cut;

use std::{
    cmp::Reverse,
    collections::{BTreeMap, HashMap},
    net::{IpAddr, SocketAddr},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering::SeqCst},
    },
    time::Duration,
};

use parking_lot::Mutex;
use tokio::{
    sync::{OwnedSemaphorePermit, Semaphore},
    time::{Instant, timeout},
};
use tokio_util::sync::CancellationToken;
use tracing::debug;

use super::{backlog::Backlogs, read_queue::ReadQueue, tls::Client};
use crate::{
    admission::{Admission, Flow},
    identity::ClientCertificate,
};

/// A connection keeps its place for this long after it was opened and after a call: its client may be about to call,
/// and the end of an answer is about to leave.
const MIN_IDLE: Duration = Duration::from_millis(100);

/// A connection with calls keeps its place for this long after its last sign of life: the beginning or end of a call, a
/// part of a request that arrived, a part of an answer that left.
const MAX_SILENCE: Duration = Duration::from_secs(10);

/// A new connection waits for this long for one of those above. Then it gets a place of the network that has the most.
const MAX_WAIT: Duration = Duration::from_secs(1);

/// The streams for reflection of a connection, and its requests for health that have not arrived whole.
pub(super) const MAX_ARRIVING: usize = 4;

/// The streams for reflection of all connections.
pub(super) const MAX_REFLECTING: usize = 32;

/// The calls of a connection that was given up.
const GIVEN_UP: usize = usize::MAX;

/// Set in [`State::rank`] by the first call.
const HAS_CALLED: u64 = 1 << 63;

/// The open connections of a listener.
#[derive(Debug)]
pub(super) struct Connections {
    places: Arc<Semaphore>,
    open: Mutex<BTreeMap<u64, Arc<State>>>,
    /// The number of connections and ended calls so far.
    events: AtomicU64,
    /// The most lasting streams of each.
    max_streams: usize,
    /// The free places of streams for reflection.
    reflecting: Arc<Semaphore>,
    admission: Admission,
    read_queue: Arc<ReadQueue>,
    /// The time since which new connections have found no room.
    full_since: Mutex<Option<Instant>>,
}

#[derive(Debug)]
struct State {
    /// The calls under way, or [`GIVEN_UP`].
    calls: AtomicUsize,
    /// The idle connection of the least rank makes room first: the number of its last event, and [`HAS_CALLED`].
    rank: AtomicU64,
    /// The time of its last sign of life.
    active_at: Mutex<Instant>,
    /// True while its client does not read an answer.
    is_stalled: AtomicBool,
    cut: CancellationToken,
    peer: Option<SocketAddr>,
    certificate: Client,
    flow: Arc<Flow>,
    /// The free places of lasting streams.
    streams: Arc<Semaphore>,
    /// Those of streams for reflection, and of requests for health that have not arrived whole.
    arriving: Arc<Semaphore>,
    unread: Mutex<UnreadFrames>,
    backlogs: Arc<Backlogs>,
}

/// The answers that wait for a client to read them.
#[derive(Debug)]
struct UnreadFrames {
    frames: usize,
    /// The time of the first of them, or that at which the client read another.
    since: Instant,
}

/// An open connection, until it is dropped.
#[derive(Debug)]
pub(super) struct Open {
    number: u64,
    activity: Activity,
    _place: OwnedSemaphorePermit,
}

/// The calls of a connection.
#[derive(Clone, Debug)]
pub(crate) struct Activity {
    connections: Arc<Connections>,
    state: Arc<State>,
}

/// A call under way, until it is dropped.
#[derive(Debug)]
pub(super) struct ActiveCall(Activity);

/// A frame of an answer on its way out, until it is dropped.
#[derive(Debug)]
pub(super) struct Sending(Arc<State>);

impl Connections {
    /// Room for `limit` connections. Each is a flow and has at most `max_streams` lasting streams.
    pub(super) fn new(limit: usize, max_streams: usize, admission: Admission) -> Arc<Self> {
        Arc::new(Self {
            places: Arc::new(Semaphore::new(limit.min(Semaphore::MAX_PERMITS))),
            open: Mutex::default(),
            events: AtomicU64::new(0),
            max_streams,
            reflecting: Arc::new(Semaphore::new(MAX_REFLECTING)),
            admission,
            read_queue: Arc::default(),
            full_since: Mutex::default(),
        })
    }

    /// The queue in which they wait to read.
    pub(super) fn read_queue(&self) -> &Arc<ReadQueue> {
        &self.read_queue
    }

    /// Waits for a place, which an idle connection gives up if there is no other. None if its network has the most
    /// connections, and none of them can be given up. `cut` ends the connection.
    pub(super) async fn open(
        self: &Arc<Self>,
        peer: Option<SocketAddr>,
        cut: CancellationToken,
    ) -> Option<Open> {
        let place = self.place(peer).await?;
        *self.full_since.lock() = None;
        let number = self.events.fetch_add(1, SeqCst);
        let state = Arc::new(State {
            calls: AtomicUsize::new(0),
            rank: AtomicU64::new(number),
            active_at: Mutex::new(Instant::now()),
            is_stalled: AtomicBool::new(false),
            cut,
            peer,
            certificate: Client::default(),
            flow: self.admission.open(),
            streams: Arc::new(Semaphore::new(self.max_streams)),
            arriving: Arc::new(Semaphore::new(MAX_ARRIVING)),
            unread: Mutex::new(UnreadFrames {
                frames: 0,
                since: Instant::now(),
            }),
            backlogs: Arc::default(),
        });
        self.open.lock().insert(number, Arc::clone(&state));
        let connections = Arc::clone(self);
        Some(Open {
            number,
            activity: Activity { connections, state },
            _place: place,
        })
    }

    async fn place(&self, peer: Option<SocketAddr>) -> Option<OwnedSemaphorePermit> {
        loop {
            if let Ok(place) = Arc::clone(&self.places).try_acquire_owned() {
                return Some(place);
            }
            let full_since = self.full_since();
            if self.give_one_up() {
                *self.full_since.lock() = None;
            } else if full_since.elapsed() >= MAX_WAIT {
                self.give_up_of_many(peer.map(network))?;
                *self.full_since.lock() = None;
            }
            // The place of the connection that was given up, or of another that ends. If none ends in time, the next one
            // is given up.
            let free = Arc::clone(&self.places).acquire_owned();
            if let Ok(Ok(place)) = timeout(MIN_IDLE, free).await {
                return Some(place);
            }
        }
    }

    /// The time since which there was no room. The listener takes one connection after another, so the wait of the first
    /// one counts for those behind it, for as long again.
    fn full_since(&self) -> Instant {
        let mut since = self.full_since.lock();
        since.take_if(|since| since.elapsed() >= 2 * MAX_WAIT);
        *since.get_or_insert_with(Instant::now)
    }

    /// Gives up the first connection without calls or, if that was opened or called just now, the one with calls that is
    /// silent for the longest time. False if there is none.
    fn give_one_up(&self) -> bool {
        let open = self.open.lock();
        let idle = open
            .values()
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
            let open = open.values().filter(|state| !state.cut.is_cancelled());
            let silent = open.min_by_key(|state| *state.active_at.lock());
            silent.filter(|state| state.silence() >= MAX_SILENCE)
        });
        if let Some(state) = given_up {
            debug!(peer = ?state.peer, "an idle or silent connection makes room for another");
            state.cut.cancel();
        }
        given_up.is_some()
    }

    /// Gives up a connection of the network that has the most, two at least: the one whose last call is the longest ago.
    /// None if that is the network of the `newcomer`.
    fn give_up_of_many(&self, newcomer: Option<IpAddr>) -> Option<()> {
        let open = self.open.lock();
        let mut networks: HashMap<IpAddr, (usize, Reverse<u64>, &State)> = HashMap::new();
        for state in open.values().filter(|state| !state.cut.is_cancelled()) {
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
        if let Some((network, (_, _, state))) = most.filter(|(_, (count, ..))| *count > 1) {
            if newcomer == Some(network) {
                debug!(%network, "a connection of the network that has the most is refused");
                return None;
            }
            debug!(peer = ?state.peer, "a connection of the network that has the most makes room for another");
            state.cut.cancel();
        }
        Some(())
    }
}

/// The network of a client: its address of IPv4, or the upper half of one of IPv6, since it may use all with that.
fn network(peer: SocketAddr) -> IpAddr {
    match peer.ip().to_canonical() {
        IpAddr::V6(address) => IpAddr::V6((address.to_bits() >> 64 << 64).into()),
        address => address,
    }
}

impl State {
    fn note_activity(&self) {
        *self.active_at.lock() = Instant::now();
    }

    /// The time since the last sign of life.
    fn silence(&self) -> Duration {
        self.active_at.lock().elapsed()
    }
}

impl Open {
    /// The calls of the connection.
    pub(super) fn activity(&self) -> &Activity {
        &self.activity
    }
}

impl Drop for Open {
    fn drop(&mut self) {
        self.activity.connections.open.lock().remove(&self.number);
    }
}

impl Activity {
    /// A call begins; `None` if the connection was given up.
    pub(super) fn begin(&self) -> Option<ActiveCall> {
        let count = |calls| (calls != GIVEN_UP).then(|| calls + 1);
        self.state.calls.fetch_update(SeqCst, SeqCst, count).ok()?;
        self.state.note_activity();
        Some(ActiveCall(self.clone()))
    }

    /// Notes that a part of a request has arrived.
    pub(super) fn note_arrival(&self) {
        self.state.note_activity();
    }

    /// Notes that bytes have left, which are a sign of life if an answer waits for its client.
    pub(super) fn note_departure(&self) {
        if self.state.unread.lock().frames > 0 {
            self.state.note_activity();
        }
    }

    /// The time since the last sign of life.
    #[cfg(test)]
    pub(super) fn silence(&self) -> Duration {
        self.state.silence()
    }

    /// Notes that its client does not read what the server sends, or reads again.
    pub(super) fn set_stalled(&self, is_stalled: bool) {
        self.state.is_stalled.store(is_stalled, SeqCst);
    }

    /// The address of its client.
    pub(super) fn peer(&self) -> Option<SocketAddr> {
        self.state.peer
    }

    /// The verified certificate of its client, if it has one.
    pub(super) fn certificate(&self) -> Option<&ClientCertificate> {
        self.state.certificate.get()
    }

    /// The place of the certificate.
    pub(super) fn client(&self) -> Client {
        Arc::clone(&self.state.certificate)
    }

    /// The flow of its calls.
    pub(super) fn flow(&self) -> &Arc<Flow> {
        &self.state.flow
    }

    /// What its streams have not read.
    pub(super) fn backlogs(&self) -> &Arc<Backlogs> {
        &self.state.backlogs
    }

    /// The place of a lasting stream; None if the others of the connection have all.
    pub(super) fn stream(&self) -> Option<OwnedSemaphorePermit> {
        Arc::clone(&self.state.streams).try_acquire_owned().ok()
    }

    /// The place of a request for health that has not arrived whole, or the two of a stream for reflection; None if others
    /// have all.
    pub(super) fn arriving(
        &self,
        reflects: bool,
    ) -> Option<(OwnedSemaphorePermit, Option<OwnedSemaphorePermit>)> {
        let take = |places: &Arc<Semaphore>| Arc::clone(places).try_acquire_owned().ok();
        let arriving = take(&self.state.arriving)?;
        match reflects {
            true => Some((arriving, Some(take(&self.connections.reflecting)?))),
            false => Some((arriving, None)),
        }
    }

    /// A frame of an answer waits for the client to read it, until the result is dropped.
    pub(super) fn send(&self) -> Sending {
        let mut unread = self.state.unread.lock();
        if unread.frames == 0 {
            unread.since = Instant::now();
        }
        unread.frames += 1;
        Sending(Arc::clone(&self.state))
    }
}

impl Drop for Sending {
    fn drop(&mut self) {
        let mut unread = self.0.unread.lock();
        unread.frames -= 1;
        unread.since = Instant::now();
        self.0.note_activity();
    }
}

impl Drop for ActiveCall {
    fn drop(&mut self) {
        let Activity { connections, state } = &self.0;
        let event = connections.events.fetch_add(1, SeqCst);
        state.rank.store(event | HAS_CALLED, SeqCst);
        state.note_activity();
        state.calls.fetch_sub(1, SeqCst);
    }
}

#[cfg(test)]
mod tests;
