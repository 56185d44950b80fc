//! Reads of stored points, possibly from a disk. They run on threads that may block, never on those that answer calls.
//! A mutation reads before it takes the index's writer ([`ReadAhead`]), and with it only after [`MAX_READS_AHEAD`]
//! reads.

use std::{
    collections::HashMap,
    sync::{Arc, LazyLock},
};

use tokio::sync::Semaphore;
use tokio_util::task::AbortOnDropHandle;

use tracing::error;

use super::{Call, Code, Error, error_map::log_error};
use crate::{
    admission::MAX_STORED_READS,
    log::{LogError, StoredPoint, View},
    observe::SparseLines,
    registry::{Hosted, Published, Writer},
};

/// The number of times that a mutation reads without the writer. The next read holds it, because other writers could
/// invalidate every read without end, and keeping their records until the read ends would take memory without bound.
pub(super) const MAX_READS_AHEAD: usize = 3;

/// Points read at once. A call can be cancelled between two batches.
pub(super) const BATCH_ROWS: usize = 256;

/// A batch ends with the point by which it has this many bytes.
const BATCH_BYTES: usize = 1024 * 1024;

/// The permits of all connections.
static READS: LazyLock<Semaphore> = LazyLock::new(|| Semaphore::new(*MAX_STORED_READS));

/// Reads from the store of the named index on a thread that may block. A queued read does not start once its caller has
/// left. It is refused once the caller has lost its rights: a stream reads many times.
pub(super) async fn read<T: Send + 'static>(
    call: &Call,
    doing: &'static str,
    index: &str,
    published: &Published,
    read: impl FnOnce(&dyn View) -> Result<T, LogError> + Send + 'static,
) -> Result<T, Error> {
    let view = (&published.view, published.is_shared);
    read_copy(call, doing, index, view, read).await
}

/// Like [`read`]. With `is_shared`, damage is that of one of several copies.
pub(super) async fn read_copy<T: Send + 'static>(
    call: &Call,
    doing: &'static str,
    index: &str,
    (view, is_shared): (&Arc<dyn View>, bool),
    read: impl FnOnce(&dyn View) -> Result<T, LogError> + Send + 'static,
) -> Result<T, Error> {
    call.check(doing)?;
    let view = Arc::clone(view);
    let own = call.permits.clone();
    // A task of its own: a client that takes nothing stops the polls of its call, which would keep the permits.
    let reading = tokio::spawn(async move {
        // The reads of a connection that has its share wait here, not in the queue of all.
        let share = match &own {
            Some(permits) => permits.read().await,
            None => None,
        };
        let permits = (share, READS.acquire().await);
        // The read of a caller that has left keeps its permits until it ends.
        let reading = tokio::task::spawn_blocking(move || {
            let _permits = permits;
            read(&*view)
        });
        AbortOnDropHandle::new(reading).await
    });
    let reading = AbortOnDropHandle::new(reading);
    match call.bound(doing, reading).await?.flatten() {
        Ok(Err(error)) if is_shared => Err(unreadable(call, index, error)),
        Ok(read) => read.map_err(|error| log_error(index, error)),
        // An awaited read fails to join only if it panicked.
        Err(_) => Err(Error::Internal {
            what: format!("index \"{index}\": the task that reads stored points panicked"),
        }),
    }
}

/// The error of a read of one of several copies. A call for another server has changed nothing yet, and goes on there.
fn unreadable(call: &Call, index: &str, error: LogError) -> Error {
    static LINES: SparseLines = SparseLines::new();
    let damage = log_error(index, error.clone());
    if damage.code() != Code::DataLoss {
        return damage;
    }
    if let Some(left_out) = LINES.next() {
        error!(error = %damage, left_out, "cannot read this copy of the index");
    }
    match call.is_forwarded {
        true => Error::IndexNotFound { name: index.into() },
        false => log_error(index, error.of_copy()),
    }
}

/// Maps a stored point to the value kept of it.
type Projection<T> = Arc<dyn Fn(&Arc<StoredPoint>) -> T + Send + Sync>;

/// Values of stored points for a mutation: read before it holds the writer, and caught up once it does.
pub(super) struct ReadAhead<T> {
    projection: Projection<T>,
    /// Points stored after the read are added, too.
    takes_new: bool,
    /// The revision that `points` are of.
    revision: u64,
    /// The writer's count of refusals when it caught up last: its values may be those of records that were refused since.
    refusals: Option<u64>,
    /// By id; None: no point is stored.
    points: HashMap<u64, Option<T>>,
}

impl<T: Send + 'static> ReadAhead<T> {
    /// An empty set.
    pub(super) fn new(
        takes_new: bool,
        projection: impl Fn(&Arc<StoredPoint>) -> T + Send + Sync + 'static,
    ) -> Self {
        Self {
            projection: Arc::new(projection),
            takes_new,
            revision: 0,
            refusals: None,
            points: HashMap::new(),
        }
    }

    /// The value of a point; None if it is not stored or not read yet.
    pub(super) fn get(&self, id: u64) -> Option<&T> {
        self.points.get(&id)?.as_ref()
    }

    /// Sets the revision that the held values are of.
    pub(super) fn begin_at(&mut self, published: &Published) {
        self.revision = published.revision;
    }

    /// Reads points of `published`, which must be the revision of the values held.
    pub(super) async fn read(
        &mut self,
        call: &Call,
        doing: &'static str,
        hosted: &Hosted,
        published: &Published,
        ids: &[u64],
    ) -> Result<(), Error> {
        self.begin_at(published);
        let mut rest = ids;
        while !rest.is_empty() {
            let read = self.read_part(call, doing, hosted, published, rest);
            (_, rest) = rest.split_at(read.await?);
        }
        Ok(())
    }

    /// Like [`ReadAhead::read`], up to the end of the first batch. Returns the number of `ids` that were read, at least one.
    pub(super) async fn read_part(
        &mut self,
        call: &Call,
        doing: &'static str,
        hosted: &Hosted,
        published: &Published,
        ids: &[u64],
    ) -> Result<usize, Error> {
        let ids: Vec<u64> = ids.iter().copied().take(BATCH_ROWS).collect();
        let projection = Arc::clone(&self.projection);
        let batch = move |view: &dyn View| {
            let (mut points, mut bytes) = (Vec::new(), 0);
            for id in ids {
                let point = view.get(id)?;
                bytes += point.as_ref().map_or(0, |point| point.bytes());
                points.push((id, point.map(|point| projection(&point))));
                if bytes >= BATCH_BYTES {
                    break;
                }
            }
            Ok::<Vec<(u64, Option<T>)>, LogError>(points)
        };
        let batch = read(call, doing, hosted.name(), published, batch).await?;
        let read = batch.len();
        self.points.extend(batch);
        Ok(read)
    }

    /// The values, None for a point that is not stored.
    pub(super) fn values(&self) -> impl Iterator<Item = &Option<T>> {
        self.points.values()
    }

    /// Forgets all values.
    pub(super) fn clear(&mut self) {
        self.points.clear();
    }

    /// Catches up to the writer's newest record from the recent and pending records; returns the bytes of the points that it
    /// takes from them. If these do not reach back far enough, it forgets all values and returns None.
    pub(super) fn catch_up(&mut self, hosted: &Hosted, writer: &Writer) -> Option<usize> {
        let before = std::mem::replace(&mut self.revision, writer.revision());
        let refusals = self.refusals.replace(writer.refusals());
        if self.points.is_empty() && !self.takes_new {
            return Some(0);
        }
        let are_void = refusals.is_some_and(|it| it != writer.refusals());
        let records = hosted.records_since(before, writer);
        let Some(records) = records.filter(|_| !are_void) else {
            self.points.clear();
            return None;
        };
        let mut bytes = 0;
        for record in records {
            let effects = record.effects();
            for id in effects.removed() {
                if let Some(point) = self.points.get_mut(id) {
                    *point = None;
                }
            }
            for (slot, point) in effects.stored().iter().enumerate() {
                if self.takes_new || self.points.contains_key(&point.id) {
                    let stored = Arc::new(StoredPoint {
                        id: point.id,
                        revision: point.revision,
                        modified: record.revision(),
                        tag: point.tag,
                        state: point.row.into(),
                        payload: effects.payload(slot),
                    });
                    bytes += stored.bytes();
                    self.points
                        .insert(point.id, Some((self.projection)(&stored)));
                }
            }
        }
        Some(bytes)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use futures_util::poll;
    use tokio::{
        runtime::Handle,
        sync::{Mutex, mpsc},
        task::unconstrained,
        time::timeout,
    };
    use tokio_util::sync::CancellationToken;

    use super::*;
    use crate::{
        admission::Admission,
        config::Config,
        log::PointStore,
        testing::{arm, log_with},
    };

    /// Two tests that hold permits at a time could wait for each other.
    static HOLDS_PERMITS: Mutex<()> = Mutex::const_new(());

    /// A read that ends once `gate` is cancelled.
    fn waits_for(
        gate: &CancellationToken,
    ) -> impl FnOnce(&dyn View) -> Result<(), LogError> + Send + 'static {
        let gate = gate.clone();
        move |_| {
            Handle::current().block_on(gate.cancelled());
            Ok(())
        }
    }

    #[tokio::test]
    async fn few_reads_are_under_way_at_a_time() {
        let _alone = HOLDS_PERMITS.lock().await;
        let entry = arm();
        let view: Arc<dyn View> = log_with(&entry, &[]).view(entry.uid).unwrap();
        let most = *MAX_STORED_READS;
        let (start, mut started) = mpsc::unbounded_channel();
        let gate = CancellationToken::new();
        let reads: Vec<_> = (0..=most)
            .map(|_| {
                let (view, start, wait) = (Arc::clone(&view), start.clone(), waits_for(&gate));
                tokio::spawn(async move {
                    let wait = move |view: &dyn View| {
                        start.send(()).unwrap();
                        wait(view)
                    };
                    read_copy(&Call::default(), "reading", "arm", (&view, false), wait).await
                })
            })
            .collect();
        for _ in 0..most {
            started.recv().await.unwrap();
        }
        assert_eq!(READS.available_permits(), 0);
        assert!(started.try_recv().is_err());
        gate.cancel();
        for read in reads {
            read.await.unwrap().unwrap();
        }
    }

    #[tokio::test]
    async fn a_read_does_not_wait_behind_those_of_another_connection() {
        let _alone = HOLDS_PERMITS.lock().await;
        let entry = arm();
        let view: Arc<dyn View> = log_with(&entry, &[]).view(entry.uid).unwrap();
        let admission = Admission::new(&Config::default().admission, 1, 0);
        let [heavy, other] = [(); 2].map(|()| Call {
            permits: Some(admission.open().permits()),
            ..Call::default()
        });
        let gate = CancellationToken::new();
        let held = || {
            let read = read_copy(&heavy, "reading", "arm", (&view, false), waits_for(&gate));
            Box::pin(unconstrained(read))
        };
        let mut reads: Vec<_> = (0..2 * *MAX_STORED_READS).map(|_| held()).collect();
        for read in &mut reads {
            assert!(poll!(read).is_pending());
        }
        let read = read_copy(&other, "reading", "arm", (&view, false), |_| Ok(()));
        let read = timeout(Duration::from_secs(10), read).await;
        // Threads that wait would keep a failed test from its end.
        gate.cancel();
        read.expect("it waited for the other connection").unwrap();
        for read in reads {
            read.await.unwrap();
        }
    }

    #[tokio::test]
    async fn damage_of_one_of_several_copies_is_no_loss() {
        let _alone = HOLDS_PERMITS.lock().await;
        let entry = arm();
        let view: Arc<dyn View> = log_with(&entry, &[]).view(entry.uid).unwrap();
        for (is_shared, code) in [(false, Code::DataLoss), (true, Code::Unavailable)] {
            let damaged = LogError::damaged_point(entry.uid, 7, "it is cut short");
            let read = move |_: &dyn View| Err::<(), _>(damaged);
            let read =
                read_copy(&Call::default(), "reading", "arm", (&view, is_shared), read).await;
            assert_eq!(read.unwrap_err().code(), code);
        }
    }

    /// HTTP/2 stops the polls of a stream whose client takes nothing.
    #[tokio::test]
    async fn calls_that_are_polled_no_more_keep_no_permits() {
        let _alone = HOLDS_PERMITS.lock().await;
        let entry = arm();
        let view: Arc<dyn View> = log_with(&entry, &[]).view(entry.uid).unwrap();
        let call = Call::default();
        let gate = CancellationToken::new();
        let unread = || {
            let read = read_copy(&call, "reading", "arm", (&view, false), waits_for(&gate));
            Box::pin(unconstrained(read))
        };
        let mut unread: Vec<_> = (0..2 * *MAX_STORED_READS).map(|_| unread()).collect();
        for read in &mut unread {
            assert!(poll!(read).is_pending());
        }
        gate.cancel();
        let read = read_copy(&call, "reading", "arm", (&view, false), |_| Ok(()));
        let read = timeout(Duration::from_secs(10), read).await;
        read.expect("it waits for permits that nobody uses")
            .unwrap();
    }
}
