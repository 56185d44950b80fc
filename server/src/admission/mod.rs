//! Admission, for all faces: what the calls of one flow may take of the server's time and memory.
//!
//! A flow is a connection of gRPC or a link of Zenoh. Its calls take [turns](turns) to compute, and hold bytes from the
//! first byte of a request to the last byte of its answer that the caller reads.

mod answer_bytes;
mod bytes;
mod call_turns;
mod client_permits;
mod held;
mod places;
mod turns;

use std::{
    sync::{
        Arc, LazyLock,
        atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering::Relaxed},
    },
    thread::available_parallelism,
    time::{Duration, Instant},
};

use serde::Deserialize;
use tokio::time::interval;
use tracing::warn;

pub(crate) use self::bytes::ByteBudget;
use self::turns::{FlowNumber, MAX_SHORT_NS, Turns};
pub(crate) use answer_bytes::{AnswerBytes, TooManyBytes};
pub(crate) use call_turns::{CallTurns, end_slice};
pub use client_permits::ClientPermits;
pub use held::HeldBytes;
pub use places::CallPlace;
pub(crate) use places::{CallPlaces, NoPlace, PlaceWait};
pub(crate) use turns::Overloaded;

/// The setting of the bytes that calls hold.
pub(crate) const MAX_BYTES: &str = "admission.max_bytes";

/// The setting of the time that calls wait under lasting load.
pub(crate) const QUEUE_TARGET_MS: &str = "admission.queue_target_ms";

/// The bytes that a call holds beside its request and its answer, about.
pub(crate) const CALL_BYTES: usize = 8 * 1024;

/// The reads of stored points at a time: two for each core, and at least 16, as a disk serves several at once. They take
/// no turns, and each has a thread.
pub(crate) static MAX_STORED_READS: LazyLock<usize> = LazyLock::new(|| {
    let cores = available_parallelism().map_or(1, usize::from);
    (2 * cores).max(16)
});

/// The creations, deletions and parts of restores that have a blocking thread at a time. They wait for one lock, and cancelled
/// ones would otherwise fill the pool, which reads, merges and answers share.
pub(crate) const MAX_CHANGES: usize = 16;

/// The interval of the lines about refused calls.
const REPORT_INTERVAL: Duration = Duration::from_secs(10);

/// A flow holds at most this part of all bytes. The calls of administration have a budget of the same size.
const SHARES: usize = 4;

/// `[admission]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct AdmissionConfig {
    /// The time that a call waits to begin while the queue stands, in milliseconds.
    pub queue_target_ms: u64,
    /// The time that it waits otherwise, in milliseconds: a queue that was not empty for longer stands.
    pub burst_ms: u64,
    /// The most bytes that requests, calls and unread answers hold.
    pub max_bytes: usize,
}

/// A flow holds little if it holds at most this part of all bytes, or two calls.
const SMALL_PARTS: usize = 1024;

/// The bytes of an answer that stock clients of gRPC take.
const STOCK_ANSWER_BYTES: usize = 4 * 1024 * 1024;

/// A call with at most this time makes its flow hurried.
const SHORT_TIME: Duration = Duration::from_secs(1);

/// See the module. Clones share it.
#[derive(Clone, Debug)]
pub(crate) struct Admission {
    turns: Arc<Turns>,
    all: Arc<ByteBudget>,
    /// The bytes of administration: no other load takes them.
    of_admin: Arc<ByteBudget>,
    /// Those of unread requests of streams.
    of_backlogs: Arc<ByteBudget>,
    /// The most bytes of one flow.
    share: usize,
    /// The bytes by which an answer may exceed its room.
    slack: usize,
    others: Arc<OtherRefusals>,
}

/// The calls that were refused for other reasons than turns and bytes.
#[derive(Debug, Default)]
struct OtherRefusals {
    /// Those of which too many were under way.
    excess: AtomicU64,
    /// Those whose requests did not arrive in time.
    slow: AtomicU64,
}

/// The calls that share turns and bytes.
#[derive(Debug)]
pub(crate) struct Flow {
    others: Arc<OtherRefusals>,
    turns: Arc<Turns>,
    number: FlowNumber,
    all: Arc<ByteBudget>,
    own: ByteBudget,
    /// The bytes by which an answer may exceed its room.
    slack: usize,
    permits: Arc<ClientPermits>,
    /// The flow of the same client's calls of administration; None if this is it.
    admin: Option<Arc<Flow>>,
    /// The calls that have come.
    calls: AtomicU64,
    /// True if the last one that was admitted has a short deadline.
    is_hurried: AtomicBool,
    /// Those that hold bytes.
    under_way: AtomicUsize,
    /// The time of the last slice of their work, in nanoseconds.
    last_slice_ns: AtomicU64,
    opened: Instant,
    /// The last time that everything its client had sent was read, in nanoseconds since `opened`; [`UNKNOWN`] for
    /// links.
    caught_up_ns: AtomicU64,
}

/// The value of [`Flow::caught_up_ns`] while it is not known.
const UNKNOWN: u64 = u64::MAX;

/// The bytes that a flow holds at most if it holds little.
fn little(all: &ByteBudget) -> usize {
    (all.max() / SMALL_PARTS).max(2 * CALL_BYTES)
}

impl Admission {
    /// At most `threads` calls compute at once. There is room for a message of `message_bytes`, whatever the settings
    /// are.
    pub(crate) fn new(config: &AdmissionConfig, threads: usize, message_bytes: usize) -> Self {
        let turns = Turns::new(
            threads,
            Duration::from_millis(config.queue_target_ms),
            Duration::from_millis(config.burst_ms),
        );
        let one_call = message_bytes.saturating_add(CALL_BYTES);
        let share = (config.max_bytes / SHARES).max(one_call);
        // A flow that holds much has half of them at most.
        let budget = |bytes: usize| Arc::new(ByteBudget::new(bytes.max(2 * one_call)));
        Self {
            turns,
            all: budget(config.max_bytes),
            of_admin: budget(config.max_bytes / SHARES),
            of_backlogs: Arc::new(ByteBudget::new(share)),
            share,
            slack: message_bytes.max(STOCK_ANSWER_BYTES),
            others: Arc::default(),
        }
    }

    /// A flow of its own.
    pub(crate) fn open(&self) -> Arc<Flow> {
        let admin = Flow::new(self, &self.of_admin, None);
        Arc::new(Flow::new(self, &self.all, Some(Arc::new(admin))))
    }

    /// The budget of the requests that streams have not read. It has the size of a share.
    pub(crate) fn of_backlogs(&self) -> &Arc<ByteBudget> {
        &self.of_backlogs
    }

    /// The refusal of a call that would wait for too long.
    pub(crate) fn overloaded(&self) -> Overloaded {
        self.turns.overloaded()
    }

    /// Writes a line now and then while calls are refused: one for each would be a load of its own.
    pub(crate) async fn report(self) {
        let mut looks = interval(REPORT_INTERVAL);
        let mut before = 0;
        loop {
            looks.tick().await;
            let refused = self.turns.refused();
            if refused > before {
                warn!(
                    calls = refused - before,
                    seconds = REPORT_INTERVAL.as_secs(),
                    "calls were refused: they would have waited for longer than {QUEUE_TARGET_MS}"
                );
            }
            before = refused;
        }
    }

    /// Counts a call that is refused because too many are under way.
    pub(crate) fn count_excess(&self) {
        self.others.excess.fetch_add(1, Relaxed);
    }

    /// The bytes that are held, and the most.
    pub(crate) fn bytes(&self) -> (u64, u64) {
        (self.all.held() as u64, self.all.max() as u64)
    }

    /// The bytes that a flow holds at most if it holds little.
    pub(crate) fn little(&self) -> usize {
        little(&self.all)
    }

    /// True while flows that hold more than a little may soon be refused more: they have half of all bytes.
    pub(crate) fn is_short_of_bytes(&self) -> bool {
        self.all.held() > self.all.max() / 8 * 3
    }

    /// The numbers of calls that were refused so far, by reason; `excess` calls exceeded the quotas of identities.
    pub(crate) fn refused(&self, excess: u64) -> [(&'static str, u64); 4] {
        [
            ("OVERLOADED", self.turns.refused()),
            (
                "TOO_MANY_BYTES",
                self.all.refused() + self.of_admin.refused() + self.of_backlogs.refused(),
            ),
            ("TOO_MANY_CALLS", excess + self.others.excess.load(Relaxed)),
            ("TOO_SLOW", self.others.slow.load(Relaxed)),
        ]
    }
}

impl Flow {
    fn new(admission: &Admission, all: &Arc<ByteBudget>, admin: Option<Arc<Flow>>) -> Self {
        Self {
            others: Arc::clone(&admission.others),
            number: match admin {
                Some(_) => admission.turns.open(),
                None => admission.turns.open_patient(),
            },
            turns: Arc::clone(&admission.turns),
            all: Arc::clone(all),
            own: ByteBudget::new(admission.share),
            slack: admission.slack,
            permits: Arc::new(ClientPermits::new(*MAX_STORED_READS / 2)),
            admin,
            calls: AtomicU64::new(0),
            is_hurried: AtomicBool::new(false),
            under_way: AtomicUsize::new(0),
            last_slice_ns: AtomicU64::new(0),
            opened: Instant::now(),
            caught_up_ns: AtomicU64::new(UNKNOWN),
        }
    }

    /// The flow of the same client's calls of administration, which an operator needs under load.
    pub(crate) fn admin(self: &Arc<Self>) -> &Arc<Self> {
        self.admin.as_ref().unwrap_or(self)
    }

    /// The number of calls that hold bytes.
    pub(crate) fn under_way(&self) -> usize {
        self.under_way.load(Relaxed)
    }

    /// Notes the time of a slice of its calls.
    fn note_slice(&self, took: Duration) {
        self.last_slice_ns.store(took.as_nanos() as u64, Relaxed);
    }

    /// True if the last slice of its calls was long, and their turns are by now.
    fn has_long_turns(&self) -> bool {
        // Most slices are short, which is known without the lock.
        self.last_slice_ns.load(Relaxed) > MAX_SHORT_NS && self.turns.are_long(self.number)
    }

    /// The number of calls that have come.
    pub(crate) fn calls(&self) -> u64 {
        self.calls.load(Relaxed)
    }

    /// Notes the time that the request of a call gives it.
    pub(crate) fn note_time(&self, time: Option<Duration>) {
        let is_hurried = time.is_some_and(|time| time <= SHORT_TIME);
        self.is_hurried.store(is_hurried, Relaxed);
    }

    /// True if its last call that was admitted has a short deadline.
    pub(crate) fn is_hurried(&self) -> bool {
        self.is_hurried.load(Relaxed)
    }

    /// Counts a call whose request did not arrive in time.
    pub(crate) fn count_slow(&self) {
        self.others.slow.fetch_add(1, Relaxed);
    }

    /// Notes that everything its client has sent is read.
    pub(crate) fn catch_up(&self) {
        let since = self.opened.elapsed().as_nanos() as u64;
        self.caught_up_ns.store(since, Relaxed);
    }

    /// The time since then.
    pub(crate) fn behind(&self, now: Instant) -> Duration {
        match self.caught_up_ns.load(Relaxed) {
            UNKNOWN => Duration::ZERO,
            since => now.saturating_duration_since(self.opened + Duration::from_nanos(since)),
        }
    }

    /// All flows may hold this many bytes if this one takes `bytes`, of which it holds `before` already. An eighth of all is for
    /// flows that hold little then, and three more for those that hold little now: a few greedy ones cannot take everything,
    /// nor can many with one large answer each.
    fn most_of_all(&self, before: usize, bytes: usize) -> usize {
        let (max, little) = (self.all.max(), little(&self.all));
        let own = self.own.held().saturating_sub(before);
        if own.saturating_add(bytes) <= little {
            max
        } else if own <= little {
            max - max / 8
        } else {
            max / 2
        }
    }

    /// Begins to count the bytes of a call.
    pub(crate) fn hold(self: &Arc<Self>) -> HeldBytes {
        HeldBytes::new(Arc::clone(self))
    }

    /// The bytes that it holds.
    pub(crate) fn held(&self) -> usize {
        self.own.held()
    }

    /// The most bytes that all flows hold.
    pub(crate) fn max_bytes(&self) -> usize {
        self.all.max()
    }

    /// The permits of its calls. Those for reads of stored points are half of all.
    pub(crate) fn permits(&self) -> Arc<ClientPermits> {
        Arc::clone(&self.permits)
    }

    /// True if somebody has them.
    pub(crate) fn has_permits(&self) -> bool {
        Arc::strong_count(&self.permits) > 1
    }

    /// The turns of a call. One of administration waits, and is not refused for it.
    pub(crate) fn turns(self: &Arc<Self>) -> CallTurns {
        self.calls.fetch_add(1, Relaxed);
        CallTurns::new(Arc::clone(self))
    }

    /// The turns of a request of a stream that has begun: it waits, and is not refused for it.
    pub(crate) fn turns_of_stream(self: &Arc<Self>) -> CallTurns {
        self.turns().of_stream()
    }
}

impl Drop for Flow {
    fn drop(&mut self) {
        self.turns.close(self.number);
    }
}

#[cfg(test)]
mod tests;
