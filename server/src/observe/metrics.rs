//! The metrics that `/metrics` shows: times of calls and syncs, and the figures that others measure at each look.

use std::{
    collections::HashMap,
    fmt,
    sync::{Arc, OnceLock, Weak},
    time::Duration,
};

use parking_lot::Mutex;
use prometheus_client::{
    collector::Collector,
    encoding::{EncodeLabelSet, text},
    metrics::{counter::Counter, family::Family, gauge::Gauge, histogram::Histogram},
    registry::{Registry, Unit},
};
use tokio::{
    sync::{Mutex as AsyncMutex, Semaphore, SemaphorePermit},
    task::spawn_blocking,
};

/// The most scrapes at a time. One is answered, the others wait.
pub(crate) const MAX_SCRAPES: usize = 8;

/// The upper bounds of the buckets of times, in seconds.
const SECONDS: [f64; 16] = [
    0.000_1, 0.000_25, 0.000_5, 0.001, 0.002_5, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5,
    10.0, 60.0,
];

/// The label of an index, once the service has found it. Clones share it.
pub(crate) type IndexLabel = Arc<OnceLock<Arc<str>>>;

/// A histogram of times.
fn times() -> Histogram {
    Histogram::new(SECONDS)
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct CallLabels {
    face: &'static str,
    verb: &'static str,
    /// Empty for a call of no index, or of one that does not exist: strangers' names make no series.
    index: Arc<str>,
    outcome: &'static str,
}

/// The name and the value of the only label of a metric.
type Label = [(&'static str, &'static str); 1];

/// The outcomes of the snapshots that the server takes.
const WRITTEN: Label = [("outcome", "written")];
const FAILED: Label = [("outcome", "failed")];

/// The metrics of a server. Clones share them.
#[derive(Clone, Debug)]
pub(crate) struct Metrics(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    /// False if no one can read the metrics.
    are_read: bool,
    registry: Mutex<Registry>,
    /// The places of scrapes.
    places: Semaphore,
    /// Held while a thread writes the metrics.
    writing: Arc<AsyncMutex<()>>,
    calls: Family<CallLabels, Histogram, fn() -> Histogram>,
    /// The series of `calls` by the name of their index.
    by_index: Mutex<HashMap<Arc<str>, IndexSeries>>,
    /// By face.
    queued: Family<Label, Histogram, fn() -> Histogram>,
    snapshots: Family<Label, Counter>,
    /// By the name of a file that the server reads again when it changes.
    wrong_files: Family<Label, Gauge>,
    no_index: Arc<str>,
}

/// The series of the calls of an index. The next new series of any index removes them once its label is gone.
#[derive(Debug)]
struct IndexSeries {
    label: Weak<str>,
    calls: Vec<CallLabels>,
}

/// A call that has ended.
pub(super) struct EndedCall<'a> {
    pub(super) face: &'static str,
    pub(super) verb: &'static str,
    pub(super) index: &'a IndexLabel,
    pub(super) outcome: &'static str,
    pub(super) took: Duration,
    /// The wait for turns; None for a call that had none.
    pub(super) queued: Option<Duration>,
}

impl Metrics {
    /// Metrics without calls; none are counted unless the metrics `are_read`.
    pub(crate) fn new(are_read: bool) -> Self {
        let calls = Family::new_with_constructor(times as fn() -> Histogram);
        let queued = Family::new_with_constructor(times as fn() -> Histogram);
        let mut registry = Registry::with_prefix("wayfold");
        registry.register_with_unit(
            "call",
            "Calls by face, verb, index and outcome, from their arrival to the last byte of the answer",
            Unit::Seconds,
            calls.clone(),
        );
        registry.register_with_unit(
            "queue",
            "The waits of calls for their turns to compute",
            Unit::Seconds,
            queued.clone(),
        );
        let snapshots = Family::default();
        // An increase shows only in a counter that was there before.
        for outcome in [WRITTEN, FAILED] {
            let _: Counter = snapshots.get_or_create_owned(&outcome);
        }
        registry.register(
            "snapshots",
            "Snapshots that the server took by its schedule, by outcome",
            snapshots.clone(),
        );
        let wrong_files = Family::default();
        registry.register(
            "files_wrong",
            "1 while a file is wrong or missing, and the server goes on with its former content",
            wrong_files.clone(),
        );
        Self(Arc::new(Inner {
            are_read,
            registry: Mutex::new(registry),
            places: Semaphore::new(MAX_SCRAPES),
            writing: Arc::default(),
            calls,
            by_index: Mutex::default(),
            queued,
            snapshots,
            wrong_files,
            no_index: "".into(),
        }))
    }

    /// Adds the times of the syncs of the log.
    pub(crate) fn add_syncs(&self, syncs: Histogram) {
        self.0.registry.lock().register_with_unit(
            "log_sync",
            "Syncs of the journal files to the disk",
            Unit::Seconds,
            syncs,
        );
    }

    /// Adds what is measured at each look.
    pub(crate) fn add(&self, collector: impl Collector) {
        let mut registry = self.0.registry.lock();
        registry.register_collector(Box::new(collector));
    }

    /// A place for a scrape; None while there are [`MAX_SCRAPES`].
    pub(crate) fn place(&self) -> Option<SemaphorePermit<'_>> {
        self.0.places.try_acquire().ok()
    }

    /// The metrics in the text format of OpenMetrics. Memory and disk are measured meanwhile: that blocks.
    pub(crate) fn text(&self) -> Result<String, fmt::Error> {
        let mut written = String::new();
        text::encode(&mut written, &self.0.registry.lock())?;
        Ok(written)
    }

    /// Writes the metrics as text on another thread. One such thread writes at a time, and a caller that leaves before its
    /// turn starts none.
    pub(crate) async fn scrape(&self) -> Result<String, fmt::Error> {
        let writing = Arc::clone(&self.0.writing).lock_owned().await;
        let metrics = self.clone();
        let text = spawn_blocking(move || {
            // The thread has the lock: it goes on without a caller too.
            let _writing = writing;
            metrics.text()
        });
        text.await.unwrap_or(Err(fmt::Error))
    }

    /// Counts a snapshot that the server took, or failed to take.
    pub(crate) fn count_snapshot(&self, is_written: bool) {
        let outcome = if is_written { WRITTEN } else { FAILED };
        self.0.snapshots.get_or_create(&outcome).inc();
    }

    /// The gauge of a file: 1 while it is wrong.
    pub(crate) fn wrong_file(&self, file: &'static str) -> Gauge {
        self.0.wrong_files.get_or_create_owned(&[("file", file)])
    }

    pub(super) fn count(&self, ended: &EndedCall<'_>) {
        let EndedCall { face, verb, .. } = *ended;
        if !self.0.are_read {
            return;
        }
        let Inner {
            calls,
            queued: queues,
            no_index,
            ..
        } = &*self.0;
        let labels = CallLabels {
            face,
            verb,
            index: Arc::clone(ended.index.get().unwrap_or(no_index)),
            outcome: ended.outcome,
        };
        let seconds = ended.took.as_secs_f64();
        match calls.get(&labels) {
            Some(series) => series.observe(seconds),
            None => self.0.add_series(labels).observe(seconds),
        }
        if let Some(queued) = ended.queued {
            let queue = queues.get_or_create(&[("face", face)]);
            queue.observe(queued.as_secs_f64());
        }
    }
}

impl Inner {
    /// Adds a series of calls, and removes those whose index gave up its label.
    fn add_series(&self, labels: CallLabels) -> Histogram {
        let mut by_index = self.by_index.lock();
        by_index.retain(|_, series| {
            let is_used = series.label.strong_count() > 0;
            for labels in series.calls.iter().filter(|_| !is_used) {
                self.calls.remove(labels);
            }
            is_used
        });
        // The keys of the series must not hold the label.
        let name: Arc<str> = (&*labels.index).into();
        let series = by_index
            .entry(Arc::clone(&name))
            .or_insert_with(|| IndexSeries {
                label: Arc::downgrade(&labels.index),
                calls: Vec::new(),
            });
        let labels = CallLabels {
            index: name,
            ..labels
        };
        let added = self.calls.get_or_create_owned(&labels);
        series.calls.push(labels);
        added
    }
}
