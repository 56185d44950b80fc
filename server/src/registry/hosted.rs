//! One index: the state that its readers see, and access to its writer.

mod closing;

use std::{
    collections::BTreeMap,
    sync::{
        Arc, Weak,
        atomic::{AtomicBool, AtomicU64, Ordering::Relaxed},
    },
    time::{Instant, SystemTime},
};

use tokio::{
    sync::{Mutex, OnceCell, mpsc, watch},
    time::timeout,
};
use tokio_util::task::AbortOnDropHandle;
use wayfold_index::{Forest, ForestSnapshot, Space};
use wayfold_proto::v1::PayloadEncoding;

use super::{
    Host, RegistryError, WriteGuard, Writer,
    apply::{self, AppliedForest, AwaitedReceipt},
    commit::LatestReads,
    in_flight::InFlight,
    operations::Operations,
    payload_sizes::PayloadSizes,
    peer_comparison::PeerComparison,
    recent::RecentRecords,
    settle::SETTLE_TIME,
    subscribers::Subscribers,
};
use crate::log::{
    Effects, Entry, LogError, Operation, RecordPosition, Retention, Uid, View, Window,
};

/// One frozen revision of an index. It does not change while it is held.
pub struct Published {
    /// The points, for search.
    pub snapshot: ForestSnapshot,
    /// The same points in the log, with payloads.
    pub view: Arc<dyn View>,
    /// The revision of both.
    pub revision: u64,
    /// True if servers share the journal.
    pub is_shared: bool,
}

/// One index.
pub struct Hosted {
    name: String,
    /// The label in metrics: the name, or `(others)`.
    label: Arc<str>,
    uid: Uid,
    uid_text: String,
    space: Arc<Space>,
    payload_encoding: PayloadEncoding,
    pub(super) host: Arc<Host>,
    state: watch::Sender<State>,
    pub(super) writer: Arc<Mutex<Writer>>,
    pub(super) applied: Arc<Mutex<AppliedForest>>,
    pub(super) in_flight: parking_lot::Mutex<InFlight>,
    pub(super) operations: parking_lot::Mutex<Operations>,
    pub(super) payload_sizes: parking_lot::Mutex<PayloadSizes>,
    /// The newest revision that may have removed or changed points.
    pub(super) last_change: AtomicU64,
    /// The published revision at the last check for idleness, and at the last check that found the index idle.
    pub(super) last_seen_revision: AtomicU64,
    pub(super) last_idle_revision: AtomicU64,
    pub(super) recent: parking_lot::Mutex<RecentRecords>,
    /// The time at which this process last applied a batch, by session.
    pub(super) session_uses: parking_lot::Mutex<BTreeMap<u64, Instant>>,
    pub(crate) subscribers: Subscribers,
    /// The records that subscribers read from the log because no publication brought them.
    pub(crate) missed: AtomicU64,
    /// The records of a shared journal that are outside of all windows and not forgotten, if this server trims it.
    pub(crate) held: AtomicU64,
    /// The revision up to which this server has forgotten records of a shared journal: it does not ask for the same again.
    pub(super) forgotten: AtomicU64,
    pub(crate) peer_comparison: PeerComparison,
    /// The oldest revision of a shared journal, 1 if it has none, once it was asked.
    pub(super) oldest_at_start: OnceCell<u64>,
    /// Each batch of a writer session holds a reference while it is under way.
    pub(crate) batches: Arc<()>,
    apply_loop: parking_lot::Mutex<ApplyLoop>,
    pub(super) latest_reads: LatestReads,
    /// True once a damage of its journal was logged.
    pub(super) is_reported: AtomicBool,
    /// True once a copy takes its place: it applies nothing more and does not resume. Set by the holder of the writer and of
    /// `applied`.
    pub(super) is_retired: AtomicBool,
    /// Set once its apply loop has panicked.
    pub(super) has_panicked: AtomicBool,
}

/// The task that applies the records of the log, and the channel of the receipts it waits for.
#[derive(Default)]
struct ApplyLoop {
    /// The number of loops before it.
    number: u64,
    /// None before the first loop.
    receipts: Option<mpsc::UnboundedSender<AwaitedReceipt>>,
    _task: Option<AbortOnDropHandle<()>>,
}

struct State {
    /// The newest revision that is applied; it is as durable as configured.
    published: Arc<Published>,
    /// The error that closed the index; no later state comes.
    closed: Option<RegistryError>,
}

impl Hosted {
    /// Serves an index from the points of `view`, which are in the forest and the sizes too, with these operations, oldest
    /// first, and follows the log from there on. Needs a runtime.
    pub(super) fn new(
        host: &Arc<Host>,
        entry: &Entry,
        (forest, payload_sizes): (Forest, PayloadSizes),
        view: Arc<dyn View>,
        remembered: Vec<Arc<Operation>>,
    ) -> Arc<Self> {
        let operations = Operations::of(host.options.operations, remembered);
        let published = Arc::new(Published {
            snapshot: forest.snapshot(),
            revision: view.revision(),
            view,
            is_shared: host.log.journal.is_shared(),
        });
        let space = Arc::new(entry.space.clone());
        let applied = published.view.position();
        let hosted = Arc::new(Self {
            name: entry.name.clone(),
            label: host.labels.of(&entry.name),
            uid: entry.uid,
            uid_text: entry.uid.to_string(),
            host: Arc::clone(host),
            writer: Arc::new(Mutex::new(Writer::new(&space, Arc::clone(&published)))),
            space,
            payload_encoding: entry.payload_encoding,
            applied: Arc::new(Mutex::new(AppliedForest { forest, mergers: 0 })),
            in_flight: parking_lot::Mutex::default(),
            operations: parking_lot::Mutex::new(operations),
            payload_sizes: parking_lot::Mutex::new(payload_sizes),
            last_change: AtomicU64::new(published.revision),
            last_seen_revision: AtomicU64::new(u64::MAX),
            last_idle_revision: AtomicU64::new(u64::MAX),
            recent: parking_lot::Mutex::new(RecentRecords::new(host.options.window_bytes)),
            session_uses: parking_lot::Mutex::default(),
            subscribers: Subscribers::default(),
            missed: AtomicU64::new(0),
            held: AtomicU64::new(0),
            forgotten: AtomicU64::new(0),
            peer_comparison: PeerComparison::default(),
            oldest_at_start: OnceCell::new(),
            latest_reads: LatestReads::default(),
            is_reported: AtomicBool::new(false),
            is_retired: AtomicBool::new(false),
            has_panicked: AtomicBool::new(false),
            batches: Arc::default(),
            apply_loop: parking_lot::Mutex::default(),
            state: watch::Sender::new(State {
                published,
                closed: None,
            }),
        });
        // A loop that began before the index exists could not tell it of an error.
        *hosted.apply_loop.lock() =
            ApplyLoop::start(0, Arc::downgrade(&hosted), host, entry.uid, applied);
        hosted
    }

    /// The bytes of its payloads after `effects`, which follow the records of `writer`; 0 if they are not counted.
    pub fn payload_bytes(&self, writer: &Writer, effects: &Effects) -> u64 {
        self.payload_sizes.lock().after(writer.pending(), effects)
    }

    /// True if other servers write to it too.
    pub fn is_shared(&self) -> bool {
        self.host.log.journal.is_shared()
    }

    /// Its name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its name in metrics; indices beyond a hundred share one.
    pub fn label(&self) -> &Arc<str> {
        &self.label
    }

    /// The label, if no other index shares it.
    pub(crate) fn own_label(&self) -> Option<&Arc<str>> {
        (*self.label == *self.name).then_some(&self.label)
    }

    /// The number of records that are submitted and not readable yet.
    pub(crate) fn records_in_flight(&self) -> usize {
        self.in_flight.lock().len()
    }

    /// The batches of writer sessions that are under way.
    pub fn batches_under_way(&self) -> usize {
        Arc::strong_count(&self.batches) - 1
    }

    /// Its uid.
    pub fn uid(&self) -> Uid {
        self.uid
    }

    /// Its uid as text.
    pub fn uid_text(&self) -> &str {
        &self.uid_text
    }

    /// True if `uid` can no longer become the uid of this name here; false in doubt.
    pub(crate) fn is_past(&self, uid: &str) -> bool {
        let catalogue = &self.host.log.catalogue;
        catalogue.is_past(&self.name, uid, Some(self.uid))
    }

    /// Its space.
    pub fn space(&self) -> &Space {
        &self.space
    }

    /// How its payloads hold edges.
    pub fn payload_encoding(&self) -> PayloadEncoding {
        self.payload_encoding
    }

    /// The state that readers see.
    pub fn published(&self) -> Arc<Published> {
        Arc::clone(&self.state.borrow().published)
    }

    /// Waits until `revision` or a later one is published.
    pub async fn reached(&self, revision: u64) -> Result<Arc<Published>, RegistryError> {
        let published = self.published();
        if published.revision >= revision {
            return Ok(published);
        }
        let mut state = self.state.subscribe();
        let seen = state
            .wait_for(|state| state.published.revision >= revision || state.closed.is_some())
            .await
            .map_err(|_| RegistryError::Deleted)?;
        match &seen.closed {
            Some(why) if seen.published.revision < revision => Err(why.clone()),
            _ => Ok(Arc::clone(&seen.published)),
        }
    }

    /// Waits for a record that is in the journal to be published; an error if it does not arrive in time.
    pub(super) fn arrival(
        &self,
        revision: u64,
    ) -> impl Future<Output = Result<(), RegistryError>> + use<> {
        let (uid, mut state) = (self.uid, self.state.subscribe());
        async move {
            let arrived = state.wait_for(|state| state.published.revision >= revision);
            match timeout(SETTLE_TIME, arrived).await {
                Ok(_) => Ok(()),
                Err(_) => Err(RegistryError::Log(LogError::Unconfirmed {
                    uid,
                    revision,
                    what: "the journal has another record in its place and does not send it".into(),
                })),
            }
        }
    }

    /// Waits for the writer, in the order of arrival.
    pub async fn write(&self) -> Result<WriteGuard, RegistryError> {
        let mut writer = self.write_closed().await;
        self.renew(&mut writer)?;
        Ok(writer)
    }

    /// Moves the writer to the published state; fails if the index is closed.
    fn renew(&self, writer: &mut Writer) -> Result<(), RegistryError> {
        let (base, refusals) = {
            // `close` changes both under this lock. Refusals count before the records that cause them are published, so no
            // pending record is kept over one that took its revision.
            let in_flight = self.in_flight.lock();
            let state = self.state.borrow();
            if let Some(why) = &state.closed {
                return Err(why.clone());
            }
            (Arc::clone(&state.published), in_flight.refusals())
        };
        writer.catch_up(base, self.last_change.load(Relaxed), refusals);
        Ok(())
    }

    /// Releases the levels and the view of the state that the writer was at, which it would hold until the next mutation.
    pub(super) fn release_former_state(&self) {
        if let Ok(mut writer) = self.writer.try_lock() {
            // A closed index goes as a whole, or its writer is renewed when it resumes.
            let _ = self.renew(&mut writer);
        }
    }

    /// Publishes a newer revision, or the same one after a merge.
    pub(super) fn publish(&self, published: &Arc<Published>) {
        self.state.send_if_modified(|state| {
            let is_newer = published.revision > state.published.revision;
            state.published = Arc::clone(published);
            is_newer
        });
    }

    /// The records that are kept for subscribers that fall behind; none while the log cannot be read.
    pub(crate) fn window(&self) -> Window {
        self.host.log.points.window(self.uid).unwrap_or_default()
    }

    /// Trims records and operations that need not be kept.
    pub(super) fn trim(&self, now: SystemTime) -> Result<(), LogError> {
        let since = now.checked_sub(self.host.options.window);
        let window = self.operations.lock().window();
        let retention = Retention {
            record_bytes: self.host.options.window_bytes,
            since: since.unwrap_or(SystemTime::UNIX_EPOCH),
            operations: window.count,
            operation_bytes: window.bytes,
        };
        self.host.log.points.trim(self.uid, &retention)
    }

    /// Waits for the writer, also if the index is closed.
    pub(super) async fn write_closed(&self) -> WriteGuard {
        Arc::clone(&self.writer).lock_owned().await
    }

    /// Gives the apply loop a receipt to wait for.
    pub(super) fn await_receipt(&self, awaited: AwaitedReceipt) {
        if let Some(receipts) = &self.apply_loop.lock().receipts {
            // It fails if the loop has ended, which closes the index.
            let _ = receipts.send(awaited);
        }
    }
}

impl ApplyLoop {
    fn start(
        number: u64,
        hosted: Weak<Hosted>,
        host: &Host,
        uid: Uid,
        applied: RecordPosition,
    ) -> Self {
        let (receipts, awaited) = mpsc::unbounded_channel();
        let records = host.log.journal.follow_applied(uid, applied);
        let task = tokio::spawn(apply::run(hosted, number, records, awaited));
        Self {
            number,
            receipts: Some(receipts),
            _task: Some(AbortOnDropHandle::new(task)),
        }
    }
}
