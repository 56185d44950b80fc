//! The use cases of the contract, and the limits that protect the server. The service knows no transport.
//!
//! Requests and responses are the messages of `wayfold.v1`: they are the contract on every transport. A face translates
//! its calls into these and holds no policy of its own.
//!
//! One verb a file. The shared files:
//! - `call`: deadlines, and time slices for long work;
//! - `check`: requests become canonical rows and searches, or violations;
//! - `read_view`: the index, the revision and the payloads that a call reads;
//! - `neighbor_spec`: number and radius of neighbours, fixed or scaled by the size of the index;
//! - `prefetch`, `payloads`: the searches and the reads of an insert before its turn to write;
//! - `staging`: rows that see the rows before them;
//! - `forward`: mutations that another server of a cluster evaluates;
//! - `peer_comparison`: before it makes a record, a server compares its newest records with those of the live members;
//! - `member`, `copy`, `heal`: copies for servers of a cluster that cannot follow their journal;
//! - `trim`: forgets the records of a shared journal that the servers have stored;
//! - `mutation`: from an evaluated mutation to its acknowledgement;
//! - `changed_points`: the stored points that a mutation changes;
//! - `stored`: reads of the store on threads that may block;
//! - `answer`: columns that never outgrow their limit;
//! - `held_scans`: scans page by page, at a revision that is held between the pages;
//! - `revision_pin`: a revision that a stream holds for a bounded time;
//! - `session_pages`: writer sessions in snapshots;
//! - `catalog_watch`: the set of served indices, for a face that announces them;
//! - `error`, `code`, `error_map`, `limits`.

mod answer;
mod call;
mod catalog_watch;
mod changed_points;
mod check;
mod code;
mod copy;
mod error;
mod error_map;
mod forward;
mod get;
mod heal;
mod held_scans;
mod indexes;
mod insert;
mod limits;
mod log;
mod member;
mod mutation;
mod neighbor_spec;
mod neighbors;
mod payloads;
mod peer_comparison;
mod prefetch;
mod read_view;
mod remove;
mod restore;
mod revision_pin;
mod scan;
mod server;
mod session;
mod session_pages;
mod snapshot;
mod staging;
mod stored;
mod trim;
mod update;
mod verify;
mod watch;
mod write;

use std::{
    sync::{
        Arc, OnceLock,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use parking_lot::Mutex;
use tokio::{sync::Semaphore, time::Instant};
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};

pub use crate::admission::{ClientPermits, HeldBytes};
use crate::{
    admission::MAX_CHANGES,
    identity::Role,
    log::{Durability, LogError},
    registry::{IndexState, Registry, RegistryError},
};
pub use call::{Call, Peer};
pub use catalog_watch::CatalogWatch;
pub use code::Code;
pub(crate) use copy::{CopyOutcome, IndexCopy};
pub use error::{Error, Unavailability, Violation};
pub use forward::{NotForwarded, Owners};
pub(crate) use held_scans::MAX_HELD_SCANS;
pub use indexes::{Damaged, Listing};
pub use limits::Limits;
pub(crate) use member::{
    COPY, CopyPart, CopyParts, CopyRequest, Peers, SERVICE, STORED, StoredRequest, StoredResponse,
    Unanswered,
};
pub use restore::RestoreCall;
pub use scan::Scan;
pub use snapshot::Snapshot;
pub use verify::Verification;
pub use watch::Watch;

/// The time for which probes get the answer of one look for damage.
const DAMAGE_AGE: Duration = Duration::from_secs(1);

/// The service: cheap to clone, used from any number of tasks.
#[derive(Clone)]
pub struct Service {
    inner: Arc<Inner>,
}

struct Inner {
    /// Set once, when the registry is open.
    registry: OnceLock<Arc<Registry>>,
    limits: Limits,
    /// Set in a cluster.
    owners: OnceLock<Arc<dyn Owners>>,
    /// Set in a cluster.
    peers: OnceLock<Arc<dyn Peers>>,
    /// The durability of an acknowledged mutation; None without a data directory.
    durability: Option<Durability>,
    ready: AtomicBool,
    stopping: CancellationToken,
    held_scans: held_scans::HeldScans,
    /// A permit for each copy that may be given to another member.
    copies: Arc<Semaphore>,
    /// A permit for each creation, deletion or part of a restore that may have a thread.
    changes: Arc<Semaphore>,
    /// The last look for damage, and what it found.
    damage: Mutex<Option<(Instant, bool)>>,
}

impl Service {
    /// A service over `registry`. It answers every call with [`Error::Unavailable`] until [`Service::set_ready`].
    pub fn new(registry: Registry, limits: Limits) -> Self {
        let service = Self::starting(limits);
        service.set_registry(Arc::new(registry));
        service
    }

    /// A service that has no registry yet, and answers every call with [`Error::Unavailable`].
    pub fn starting(limits: Limits) -> Self {
        Self::starting_durable(limits, None)
    }

    /// A starting service of a server that keeps its indices in a directory with this durability.
    pub(crate) fn starting_durable(limits: Limits, durability: Option<Durability>) -> Self {
        Self {
            inner: Arc::new(Inner {
                registry: OnceLock::new(),
                limits,
                owners: OnceLock::new(),
                peers: OnceLock::new(),
                durability,
                ready: AtomicBool::new(false),
                stopping: CancellationToken::new(),
                held_scans: Default::default(),
                copies: Arc::new(Semaphore::new(copy::MAX_COPIES)),
                changes: Arc::new(Semaphore::new(MAX_CHANGES)),
                damage: Mutex::default(),
            }),
        }
    }

    /// Sets the registry; a second one is ignored.
    pub fn set_registry(&self, registry: Arc<Registry>) {
        // The cell returns a second registry, which is dropped.
        let _ = self.inner.registry.set(registry);
    }

    /// Sets the owners of the indices of a cluster; a second call changes nothing.
    pub fn set_owners(&self, owners: Arc<dyn Owners>) {
        // The cell returns the second ones.
        let _ = self.inner.owners.set(owners);
    }

    /// Sets the other members of a cluster; a second call changes nothing.
    pub(crate) fn set_peers(&self, peers: Arc<dyn Peers>) {
        // The cell returns the second ones.
        let _ = self.inner.peers.set(peers);
    }

    /// Begins to answer calls; call it once the registry has replayed its log.
    pub fn set_ready(&self) {
        self.inner.ready.store(true, Ordering::Release);
    }

    /// Answers new calls with [`Error::Unavailable`] from now on. Accepted calls run to their end.
    pub fn begin_shutdown(&self) {
        self.inner.stopping.cancel();
        self.inner.held_scans.release();
    }

    /// True if new calls are answered.
    pub fn is_serving(&self) -> bool {
        self.unavailability().is_none()
    }

    /// False once the store cannot be read, and no index with it.
    pub(crate) fn accepts_reads(&self) -> bool {
        let failure = self.opened().and_then(Registry::failure);
        !matches!(failure, Some(RegistryError::Log(LogError::Unopened { .. })))
    }

    /// True while this server of a cluster answers calls as well as the others: see [`Registry::fitness`]. None before the
    /// registry is open.
    pub(crate) fn fitness(&self) -> Option<tokio::sync::watch::Receiver<bool>> {
        self.opened().map(Registry::fitness)
    }

    /// True if mutations that add points are accepted now.
    pub(crate) fn accepts_growth(&self) -> bool {
        self.is_serving() && self.opened().is_some_and(Registry::accepts_growth)
    }

    /// True if an index is damaged: it is not served, or follows its journal no more.
    pub(crate) fn has_damage(&self) -> bool {
        self.opened().is_some_and(Registry::has_damage)
    }

    /// [`Service::has_damage`], at most [`DAMAGE_AGE`] old: probes are unauthenticated, and a look visits every index.
    pub(crate) fn has_damage_cached(&self) -> bool {
        let mut last = self.inner.damage.lock();
        match *last {
            Some((at, found)) if at.elapsed() < DAMAGE_AGE => found,
            _ => last.insert((Instant::now(), self.has_damage())).1,
        }
    }

    /// The registry once it is open.
    pub(crate) fn opened(&self) -> Option<&Registry> {
        self.inner.registry.get().map(|registry| &**registry)
    }

    /// All indices; none before they are read.
    pub(crate) fn listed(&self) -> Vec<(String, IndexState)> {
        let every = |registry: &Registry| registry.page(None, usize::MAX, |_| true).ok();
        self.opened().and_then(every).unwrap_or_default()
    }

    /// Ends when the server begins to stop.
    pub(crate) fn stopping(&self) -> WaitForCancellationFutureOwned {
        self.inner.stopping.clone().cancelled_owned()
    }

    fn unavailability(&self) -> Option<Unavailability> {
        if self.inner.stopping.is_cancelled() {
            Some(Unavailability::Stopping)
        } else if !self.inner.ready.load(Ordering::Acquire) {
            Some(Unavailability::Starting)
        } else {
            None
        }
    }

    /// Accepts a call that needs `role` on an index, or refuses it; the first thing that every verb does. The rights
    /// count before the existence of the index: a stranger does not learn of it.
    fn accept(&self, call: &Call, role: Role, index: Option<&str>) -> Result<(), Error> {
        Self::authorize(call, role, index)?;
        if let Some(why) = self.unavailability() {
            return Err(Error::Unavailable { why });
        }
        call.check("before the call began")
    }

    /// Refuses a call whose caller lacks `role` on the index; without an index, on any.
    fn authorize(call: &Call, role: Role, index: Option<&str>) -> Result<(), Error> {
        let rights = call.caller.authorize(role, index);
        rights.map_err(|why| Error::Denied { why })
    }

    /// Refuses a call that may not read the metrics, which name all indices.
    pub(crate) fn authorize_metrics(call: &Call) -> Result<(), Error> {
        Self::authorize(call, Role::Read, None)?;
        let rights = call.caller.oversee();
        rights.map_err(|why| Error::Denied { why })
    }

    /// The registry; every accepted call has one.
    fn registry(&self) -> Result<&Arc<Registry>, Error> {
        self.inner.registry.get().ok_or(Error::Unavailable {
            why: Unavailability::Starting,
        })
    }

    pub(crate) fn limits(&self) -> &Limits {
        &self.inner.limits
    }
}
