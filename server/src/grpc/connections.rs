//! The open connections: their signs of life, their flows, and the places that they have.

mod cut;
mod places;

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
    time::Instant,
};
use tokio_util::sync::CancellationToken;

pub(super) use cut::PausedAnswer;
use places::{Place, Places};

use super::{backlog::ConnectionBacklog, read_queue::ReadQueue, tls::Client};
use crate::{
    admission::{Admission, Flow},
    identity::ClientCertificate,
};

/// The streams for reflection of a connection, and its requests for health that have not arrived whole.
pub(super) const MAX_ARRIVING: usize = 4;

/// The watches of health of a connection: more than there are names.
pub(super) const MAX_WATCHING: usize = 8;

/// The streams for reflection of all connections.
pub(super) const MAX_REFLECTING: usize = 32;

/// The calls of a connection that was given up.
const GIVEN_UP: usize = usize::MAX;

/// Set in [`State::rank`] by the first call.
const HAS_CALLED: u64 = 1 << 63;

/// The open connections of a listener.
#[derive(Debug)]
pub(super) struct Connections {
    places: Places,
    open: Mutex<BTreeMap<u64, Arc<State>>>,
    /// The number of connections and ended calls so far.
    events: AtomicU64,
    /// The most lasting streams of each.
    max_streams: usize,
    /// The free places of streams for reflection.
    reflecting: Arc<Semaphore>,
    admission: Admission,
    read_queue: Arc<ReadQueue>,
    /// The last look at all backlogs.
    looked_at: Mutex<Option<Instant>>,
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
    /// None once it has ended.
    place: Mutex<Option<Place>>,
    peer: Option<SocketAddr>,
    certificate: Client,
    flow: Arc<Flow>,
    /// The free places of lasting streams.
    streams: Arc<Semaphore>,
    /// Those of streams for reflection, and of requests for health that have not arrived whole.
    arriving: Arc<Semaphore>,
    /// Those of watches of health.
    watching: Arc<Semaphore>,
    waits: Mutex<Waits>,
    backlog: Arc<ConnectionBacklog>,
}

/// The frames of answers that a client has not read, and the parts of requests whose rest it has not sent.
#[derive(Debug)]
struct Waits {
    /// The bytes of both.
    bytes: usize,
    /// The number of frames.
    frames: usize,
    /// The answers that are [paused](PausedAnswer).
    paused: usize,
    /// The time since which the first of the frames waits, or the last time that the client read one.
    frames_since: Instant,
    /// The bytes that the client has read or sent.
    moved: u64,
    /// The time of the last look, and the values then.
    looked_at: Instant,
    bytes_then: usize,
    moved_then: u64,
    /// The bytes that had waited since the look before that, if the client had moved too few meanwhile; 0 otherwise.
    late_bytes: usize,
}

/// An open connection, until it is dropped.
#[derive(Debug)]
pub(super) struct Open {
    number: u64,
    activity: Activity,
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
pub(super) struct Sending(Waiting);

/// Bytes that wait for a client to read them or to send the rest, until this is dropped.
#[derive(Debug)]
pub(super) struct Waiting {
    state: Arc<State>,
    bytes: usize,
}

impl Connections {
    /// Room for `limit` connections. Each is a flow and has at most `max_streams` lasting streams.
    pub(super) fn new(limit: usize, max_streams: usize, admission: Admission) -> Arc<Self> {
        Arc::new(Self {
            places: Places::new(limit),
            open: Mutex::default(),
            events: AtomicU64::new(0),
            max_streams,
            reflecting: Arc::new(Semaphore::new(MAX_REFLECTING)),
            admission,
            read_queue: Arc::default(),
            looked_at: Mutex::default(),
        })
    }

    /// The queue in which they wait to read.
    pub(super) fn read_queue(&self) -> &Arc<ReadQueue> {
        &self.read_queue
    }

    /// Waits for a [place](places). None if there is not even that of a guest. `cut` ends the connection.
    pub(super) async fn open(
        self: &Arc<Self>,
        peer: Option<SocketAddr>,
        cut: CancellationToken,
    ) -> Option<Open> {
        let place = self.place(peer).await?;
        let number = self.events.fetch_add(1, SeqCst);
        let state = Arc::new(State {
            calls: AtomicUsize::new(0),
            rank: AtomicU64::new(number),
            active_at: Mutex::new(Instant::now()),
            is_stalled: AtomicBool::new(false),
            cut,
            place: Mutex::new(Some(place)),
            peer,
            certificate: Client::default(),
            flow: self.admission.open(),
            streams: Arc::new(Semaphore::new(self.max_streams)),
            arriving: Arc::new(Semaphore::new(MAX_ARRIVING)),
            watching: Arc::new(Semaphore::new(MAX_WATCHING)),
            waits: Mutex::new(Waits {
                bytes: 0,
                frames: 0,
                paused: 0,
                frames_since: Instant::now(),
                moved: 0,
                looked_at: Instant::now(),
                bytes_then: 0,
                moved_then: 0,
                late_bytes: 0,
            }),
            backlog: Arc::new(ConnectionBacklog::new(Arc::clone(
                self.admission.of_backlogs(),
            ))),
        });
        self.open.lock().insert(number, Arc::clone(&state));
        let connections = Arc::clone(self);
        Some(Open {
            number,
            activity: Activity { connections, state },
        })
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
        let Activity { connections, state } = &self.activity;
        connections.open.lock().remove(&self.number);
        state.place.lock().take();
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
    pub(super) fn note_arrival(&self, bytes: usize) {
        self.state.waits.lock().moved += bytes as u64;
        self.state.note_activity();
    }

    /// Notes that bytes have left, which are a sign of life if an answer waits for its client.
    pub(super) fn note_departure(&self, bytes: usize) {
        let mut waits = self.state.waits.lock();
        waits.moved += bytes as u64;
        if waits.frames > 0 {
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

    /// The unread requests of its streams.
    pub(super) fn backlog(&self) -> &Arc<ConnectionBacklog> {
        &self.state.backlog
    }

    /// The place of a lasting stream; None if the others of the connection have all.
    pub(super) fn stream(&self) -> Option<OwnedSemaphorePermit> {
        Arc::clone(&self.state.streams).try_acquire_owned().ok()
    }

    /// The place of a watch of health; None if others have all.
    pub(super) fn watching(&self) -> Option<OwnedSemaphorePermit> {
        Arc::clone(&self.state.watching).try_acquire_owned().ok()
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

    /// Counts a frame of an answer, whose buffer has `bytes`, as unread until the result is dropped.
    pub(super) fn send(&self, bytes: usize) -> Sending {
        let mut waits = self.state.waits.lock();
        if waits.frames == 0 {
            waits.frames_since = Instant::now();
        }
        waits.frames += 1;
        Sending(self.waiting(&mut waits, bytes))
    }

    /// Counts a part of a request, whose rest the client has to send, until the result is dropped.
    pub(super) fn wait(&self, bytes: usize) -> Waiting {
        self.waiting(&mut self.state.waits.lock(), bytes)
    }

    fn waiting(&self, waits: &mut Waits, bytes: usize) -> Waiting {
        waits.bytes += bytes;
        Waiting {
            state: Arc::clone(&self.state),
            bytes,
        }
    }
}

impl Drop for Sending {
    fn drop(&mut self) {
        let state = &self.0.state;
        let mut waits = state.waits.lock();
        waits.frames -= 1;
        waits.frames_since = Instant::now();
        state.note_activity();
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        self.state.waits.lock().bytes -= self.bytes;
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
