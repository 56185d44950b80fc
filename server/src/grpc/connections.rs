//! The open connections, and the choice of the one that makes room for another.
//!
//! A client that only holds connections cannot lock others out: once all places are taken, a new connection gets the
//! place of one without a call under way. Connections that never made a call go first, then those whose last call is
//! the longest ago. A client reconnects at its next call. Health and reflection are no calls of this kind.

use std::{
    collections::BTreeMap,
    net::SocketAddr,
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

use crate::admission::ByteBudget;

/// A connection keeps its place for this long after it was opened and after a call: its client may be about to call, and
/// the end of an answer is about to leave.
const MIN_IDLE: Duration = Duration::from_millis(100);

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
    /// The most bytes that the requests of one connection may hold.
    max_request_bytes: usize,
}

#[derive(Debug)]
struct State {
    /// The calls under way, or [`GIVEN_UP`].
    calls: AtomicUsize,
    /// The connection of the least rank makes room first: the number of its last event, and [`HAS_CALLED`].
    rank: AtomicU64,
    /// The time of that event.
    idle_since: Mutex<Instant>,
    /// True while its client does not read an answer.
    is_stalled: AtomicBool,
    cut: CancellationToken,
    peer: Option<SocketAddr>,
    /// The bytes that the requests of its calls hold.
    request_bytes: ByteBudget,
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

impl Connections {
    /// Room for `limit` connections, whose requests may hold `max_request_bytes` each.
    pub(super) fn new(limit: usize, max_request_bytes: usize) -> Arc<Self> {
        Arc::new(Self {
            places: Arc::new(Semaphore::new(limit.min(Semaphore::MAX_PERMITS))),
            open: Mutex::default(),
            events: AtomicU64::new(0),
            max_request_bytes,
        })
    }

    /// Waits for a place, which an idle connection gives up if there is no other. `cut` ends the connection.
    pub(super) async fn open(
        self: &Arc<Self>,
        peer: Option<SocketAddr>,
        cut: CancellationToken,
    ) -> Open {
        let place = self.place().await;
        let number = self.events.fetch_add(1, SeqCst);
        let state = Arc::new(State {
            calls: AtomicUsize::new(0),
            rank: AtomicU64::new(number),
            idle_since: Mutex::new(Instant::now()),
            is_stalled: AtomicBool::new(false),
            cut,
            peer,
            request_bytes: ByteBudget::new(self.max_request_bytes),
        });
        self.open.lock().insert(number, Arc::clone(&state));
        let connections = Arc::clone(self);
        Open {
            number,
            activity: Activity { connections, state },
            _place: place,
        }
    }

    async fn place(&self) -> OwnedSemaphorePermit {
        let mut is_given_up = false;
        loop {
            if let Ok(place) = Arc::clone(&self.places).try_acquire_owned() {
                return place;
            }
            is_given_up = is_given_up || self.give_one_up();
            // The place of the connection that was given up, or of another that ends.
            let free = Arc::clone(&self.places).acquire_owned();
            if let Ok(Ok(place)) = timeout(MIN_IDLE, free).await {
                return place;
            }
        }
    }

    /// Gives up the first connection without calls; false if there is none, or not for long enough.
    fn give_one_up(&self) -> bool {
        let open = self.open.lock();
        let idle = open
            .values()
            .filter(|state| state.calls.load(SeqCst) == 0 && !state.is_stalled.load(SeqCst));
        let first = idle.min_by_key(|state| state.rank.load(SeqCst));
        // A younger one is waited for: one that has called does not leave in its place.
        let given_up = first.filter(|state| {
            let is_old = state.idle_since.lock().elapsed() >= MIN_IDLE;
            is_old
                && state
                    .calls
                    .compare_exchange(0, GIVEN_UP, SeqCst, SeqCst)
                    .is_ok()
        });
        if let Some(state) = given_up {
            debug!(peer = ?state.peer, "an idle connection makes room for another");
            state.cut.cancel();
        }
        given_up.is_some()
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
        Some(ActiveCall(self.clone()))
    }

    /// Notes that its client does not read what the server sends, or reads again.
    pub(super) fn set_stalled(&self, is_stalled: bool) {
        self.state.is_stalled.store(is_stalled, SeqCst);
    }

    /// The bytes that the requests of its calls hold.
    pub(super) fn request_bytes(&self) -> &ByteBudget {
        &self.state.request_bytes
    }
}

impl Drop for ActiveCall {
    fn drop(&mut self) {
        let Activity { connections, state } = &self.0;
        let event = connections.events.fetch_add(1, SeqCst);
        state.rank.store(event | HAS_CALLED, SeqCst);
        *state.idle_since.lock() = Instant::now();
        state.calls.fetch_sub(1, SeqCst);
    }
}
