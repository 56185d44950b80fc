//! The open connections, and the choice of the one that makes room for another.
//!
//! A client that only holds connections cannot lock others out: once all places are taken, a new connection gets the
//! place of one without a call under way. Connections that never made a call go first, then those whose last call is
//! the longest ago. If all others have calls, the one that has been silent for the longest time goes, such as one with an
//! idle stream. A client reconnects at its next call. Health and reflection are no calls of this kind.

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
    time::{Instant, interval, timeout},
};
use tokio_util::sync::CancellationToken;
use tracing::debug;

use super::tls::Client;
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
    admission: Admission,
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
    unread: Mutex<UnreadFrames>,
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
            admission,
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
            active_at: Mutex::new(Instant::now()),
            is_stalled: AtomicBool::new(false),
            cut,
            peer,
            certificate: Client::default(),
            flow: self.admission.open(),
            streams: Arc::new(Semaphore::new(self.max_streams)),
            unread: Mutex::new(UnreadFrames {
                frames: 0,
                since: Instant::now(),
            }),
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
        loop {
            if let Ok(place) = Arc::clone(&self.places).try_acquire_owned() {
                return place;
            }
            self.give_one_up();
            // The place of the connection that was given up, or of another that ends. If none ends in time, the next one
            // is given up.
            let free = Arc::clone(&self.places).acquire_owned();
            if let Ok(Ok(place)) = timeout(MIN_IDLE, free).await {
                return place;
            }
        }
    }

    /// Gives up the first connection without calls or, if that was opened or called just now, the one with calls that is
    /// silent for the longest time.
    fn give_one_up(&self) {
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
    }

    /// Cuts each connection whose client reads nothing of its answers for `most`.
    pub(super) async fn cut_unread(&self, most: Duration) {
        let mut checks = interval(most / 4);
        loop {
            checks.tick().await;
            for state in self.open.lock().values() {
                let unread = state.unread.lock();
                if unread.frames > 0 && unread.since.elapsed() > most {
                    debug!(peer = ?state.peer, "a client that does not read its answers is cut");
                    state.cut.cancel();
                }
            }
        }
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

    /// The place of a lasting stream; None if the others of the connection have all.
    pub(super) fn stream(&self) -> Option<OwnedSemaphorePermit> {
        Arc::clone(&self.state.streams).try_acquire_owned().ok()
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
mod tests {
    use std::pin::pin;

    use futures_util::poll;
    use tokio::time::advance;

    use super::*;
    use crate::config::Config;

    /// Two connections fill the table. Each has a stream: one is silent, over the other an answer leaves now and then.
    #[tokio::test(start_paused = true)]
    async fn a_silent_stream_makes_room_only_after_its_time() {
        let admission = Admission::new(&Config::default().admission, 1, 0);
        let connections = Connections::new(2, 1, admission);
        let cuts = [CancellationToken::new(), CancellationToken::new()];
        let silent = connections.open(None, cuts[0].clone()).await;
        let live = connections.open(None, cuts[1].clone()).await;
        let _streams = [silent.activity().begin(), live.activity().begin()];
        let mut third = pin!(connections.open(None, CancellationToken::new()));
        let step = MAX_SILENCE / 10;
        for _ in 0..9 {
            assert!(poll!(third.as_mut()).is_pending());
            assert!(!cuts[0].is_cancelled());
            drop(live.activity().send());
            advance(step).await;
        }
        advance(step).await;
        assert!(poll!(third.as_mut()).is_pending());
        assert!(cuts[0].is_cancelled() && !cuts[1].is_cancelled());
        drop(silent);
        third.await;
        assert!(!cuts[1].is_cancelled());
    }

    #[tokio::test(start_paused = true)]
    async fn a_cut_connection_that_does_not_end_is_not_the_only_one_cut() {
        let admission = Admission::new(&Config::default().admission, 1, 0);
        let connections = Connections::new(2, 1, admission);
        let cuts = [CancellationToken::new(), CancellationToken::new()];
        let _first = connections.open(None, cuts[0].clone()).await;
        let _second = connections.open(None, cuts[1].clone()).await;
        let third = connections.open(None, CancellationToken::new());
        assert!(timeout(10 * MIN_IDLE, third).await.is_err());
        assert!(cuts.iter().all(CancellationToken::is_cancelled));
    }
}
