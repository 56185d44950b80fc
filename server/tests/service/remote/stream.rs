//! The journal on the other machine.

use std::{
    collections::BTreeMap,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering::Relaxed},
    },
};

use futures_util::{FutureExt, StreamExt, stream};
use parking_lot::Mutex;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::sync::{Semaphore, SemaphorePermit, mpsc, oneshot, watch};
use wayfold_server::log::{
    Effects, Journal, LogError, Receipt, Record, RecordPosition, RecordStream, Uid,
};

/// The fault of one request.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Fault {
    /// The request does not arrive.
    LostRequest,
    /// The request arrives after the next one, and its answer does not.
    LateRequest,
    /// The request arrives, and its answer does not.
    LostAnswer,
    /// An empty record of another writer arrives first.
    Fence,
}

/// The messages of all indices in the order of their arrival, and the chance that a request or its answer is lost.
pub(crate) struct Stream {
    messages: Mutex<Vec<(Uid, Arc<Record>)>>,
    length: watch::Sender<usize>,
    random: Mutex<ChaCha8Rng>,
    loses: f64,
    /// The number of the request with a fault.
    fault: Option<(usize, Fault)>,
    requests: AtomicUsize,
    late: Mutex<Option<(Uid, Arc<Record>)>>,
    /// The origins of restored indices, and the newest trimmed revision of each trimmed index.
    pub(super) origins: Mutex<BTreeMap<Uid, RecordPosition>>,
    pub(super) trimmed: Mutex<BTreeMap<Uid, u64>>,
    /// True while no request reaches it.
    pub(super) is_cut: AtomicBool,
}

impl Stream {
    pub(crate) fn new(seed: u64, loses: f64) -> Arc<Self> {
        Self::with_fault(seed, loses, None)
    }

    /// A stream that loses nothing, but has this fault at the request of this number, counted from 0.
    pub(crate) fn failing_at(request: usize, fault: Fault) -> Arc<Self> {
        Self::with_fault(0, 0.0, Some((request, fault)))
    }

    fn with_fault(seed: u64, loses: f64, fault: Option<(usize, Fault)>) -> Arc<Self> {
        Arc::new(Self {
            messages: Mutex::default(),
            length: watch::Sender::new(0),
            random: Mutex::new(ChaCha8Rng::seed_from_u64(seed)),
            loses,
            fault,
            requests: AtomicUsize::new(0),
            late: Mutex::default(),
            origins: Mutex::default(),
            trimmed: Mutex::default(),
            is_cut: AtomicBool::new(false),
        })
    }

    /// The number of requests so far.
    pub(crate) fn requests(&self) -> usize {
        self.requests.load(Relaxed)
    }

    pub(crate) fn records(&self, uid: Uid) -> Vec<Arc<Record>> {
        let messages = self.messages.lock();
        let records = messages.iter().filter(|(of, _)| *of == uid);
        records.map(|(_, record)| Arc::clone(record)).collect()
    }

    /// Loses the newest records of an index.
    pub(super) fn lose_after(&self, uid: Uid, revision: u64) {
        let mut messages = self.messages.lock();
        messages.retain(|(of, record)| *of != uid || record.revision() <= revision);
    }

    fn is_lost(&self) -> bool {
        self.is_cut.load(Relaxed) || self.random.lock().random_bool(self.loses)
    }

    fn publish(&self, uid: Uid, record: &Arc<Record>) -> Result<(), LogError> {
        let unconfirmed = Err(LogError::Unconfirmed {
            uid,
            revision: record.revision(),
            what: "the connection was cut".into(),
        });
        let request = self.requests.fetch_add(1, Relaxed);
        let fault = self.fault.filter(|(at, _)| *at == request);
        let fault = fault.map(|(_, fault)| fault);
        if fault == Some(Fault::LostRequest) || self.is_lost() {
            return unconfirmed;
        }
        if fault == Some(Fault::LateRequest) {
            *self.late.lock() = Some((uid, Arc::clone(record)));
            return unconfirmed;
        }
        if fault == Some(Fault::Fence) {
            let other = Record::after(self.newest(uid), Effects::new(1));
            self.accept(uid, &Arc::new(other))?;
        }
        let outcome = self.accept(uid, record);
        if let Some((uid, late)) = self.late.lock().take() {
            // Nobody hears its outcome.
            let _ = self.accept(uid, &late);
        }
        if fault == Some(Fault::LostAnswer) || self.is_lost() {
            return unconfirmed;
        }
        outcome
    }

    pub(crate) fn newest(&self, uid: Uid) -> RecordPosition {
        self.newest_of(&self.messages.lock(), uid)
    }

    fn newest_of(&self, messages: &[(Uid, Arc<Record>)], uid: Uid) -> RecordPosition {
        let newest = messages.iter().rfind(|(of, _)| *of == uid);
        newest.map_or_else(|| self.origin(uid), |(_, newest)| newest.position())
    }

    fn origin(&self, uid: Uid) -> RecordPosition {
        let origins = self.origins.lock();
        origins.get(&uid).copied().unwrap_or(RecordPosition::START)
    }

    /// The records after the revision `after` that are not trimmed.
    pub(super) fn after(&self, uid: Uid, after: Option<u64>) -> Result<Vec<Arc<Record>>, LogError> {
        let trimmed = self.trimmed.lock().get(&uid).copied();
        let oldest = trimmed.unwrap_or(self.origin(uid).revision);
        let after = after.unwrap_or(oldest);
        if after < oldest {
            return Err(LogError::trimmed(uid, after, oldest));
        }
        let mut records = self.records(uid);
        records.retain(|record| record.revision() > after);
        Ok(records)
    }

    fn accept(&self, uid: Uid, record: &Arc<Record>) -> Result<(), LogError> {
        // Held until the record is here: of two writers at a revision one wins.
        let mut messages = self.messages.lock();
        let newest = self.newest_of(&messages, uid);
        if !record.follows(newest) {
            return Err(LogError::fenced(
                uid,
                record.revision() - 1,
                newest.revision,
            ));
        }
        messages.push((uid, Arc::clone(record)));
        self.length.send_replace(messages.len());
        Ok(())
    }
}

/// A record to publish, and the channel for its outcome.
type Submission = (Uid, Arc<Record>, oneshot::Sender<Result<(), LogError>>);

/// A server's connection to the stream. It publishes records one by one, each after a message of a foreign index.
pub(crate) struct Remote {
    stream: Arc<Stream>,
    submissions: mpsc::UnboundedSender<Submission>,
    /// One permit a record that may be published; a test delays the server by taking permits.
    turns: Arc<Semaphore>,
    /// True while no record reaches the server, until it reads the stream itself.
    is_behind: watch::Sender<bool>,
    /// The most points of a record.
    pub(super) max_points: AtomicUsize,
}

impl Remote {
    pub(crate) fn connect(stream: &Arc<Stream>) -> Arc<Self> {
        let (submissions, mut waiting) = mpsc::unbounded_channel::<Submission>();
        let turns = Arc::new(Semaphore::new(Semaphore::MAX_PERMITS));
        let remote = Arc::new(Self {
            stream: Arc::clone(stream),
            submissions,
            turns: Arc::clone(&turns),
            is_behind: watch::Sender::new(false),
            max_points: AtomicUsize::new(usize::MAX),
        });
        let stream = Arc::clone(stream);
        tokio::spawn(async move {
            while let Some((uid, record, answer)) = waiting.recv().await {
                turns.acquire().await.unwrap().forget();
                let foreign = Record::after(RecordPosition::START, Effects::new(1));
                stream
                    .messages
                    .lock()
                    .push((Uid::unique(), Arc::new(foreign)));
                // Fails if the server has ended.
                let _ = answer.send(stream.publish(uid, &record));
            }
        });
        remote
    }
}

impl Remote {
    /// Holds all records back until the permit is dropped, except those that are let pass.
    pub(crate) async fn hold(&self) -> SemaphorePermit<'_> {
        let permit = self.turns.acquire_many(u32::MAX >> 3).await.unwrap();
        let every = self.turns.available_permits();
        self.turns.forget_permits(every);
        permit
    }

    /// Keeps records from the server until it reads the stream itself.
    pub(crate) fn fall_behind(&self) {
        self.is_behind.send_replace(true);
    }

    /// Lets records reach the server again.
    pub(super) fn come_back(&self) {
        self.is_behind.send_replace(false);
    }

    /// Lets this many records pass.
    pub(crate) fn let_pass(&self, records: usize) {
        self.turns.add_permits(records);
    }
}

impl Journal for Remote {
    fn submit(&self, uid: Uid, record: Arc<Record>) -> Result<Receipt, LogError> {
        let (answer, outcome) = oneshot::channel();
        let submitted = self.submissions.send((uid, record, answer));
        submitted.map_err(|_| LogError::Closed)?;
        let outcome = outcome.map(|outcome| outcome.unwrap_or(Err(LogError::Closed)));
        Ok(Receipt::Awaited(outcome.boxed()))
    }

    fn check_size(&self, uid: Uid, effects: &Effects) -> Result<(), LogError> {
        let (points, max_points) = (effects.len(), self.max_points.load(Relaxed));
        if points <= max_points {
            return Ok(());
        }
        Err(LogError::RecordTooLarge {
            uid,
            bytes: points,
            max_bytes: max_points,
        })
    }

    fn follow(&self, uid: Uid, after: u64) -> RecordStream {
        let stream = Arc::clone(&self.stream);
        let is_behind = self.is_behind.subscribe();
        let position = Some((stream.length.subscribe(), after));
        let batches = stream::unfold(position, move |position| {
            let (stream, mut is_behind) = (Arc::clone(&stream), is_behind.clone());
            async move {
                let (mut length, after) = position?;
                loop {
                    is_behind.wait_for(|is_behind| !is_behind).await.ok()?;
                    length.borrow_and_update();
                    let records = match stream.after(uid, Some(after)) {
                        Ok(records) => records,
                        Err(why) => return Some((Err(why), None)),
                    };
                    if let Some(last) = records.last().map(|last| last.revision())
                        && !*is_behind.borrow()
                    {
                        return Some((Ok(records), Some((length, last))));
                    }
                    length.changed().await.ok()?;
                }
            }
        });
        batches.boxed()
    }

    fn read(
        &self,
        uid: Uid,
        after: Option<u64>,
        max_bytes: usize,
    ) -> Result<Vec<Arc<Record>>, LogError> {
        let mut records = self.stream.after(uid, after)?;
        self.come_back();
        let (mut bytes, mut fits) = (0, 0);
        for record in &records {
            bytes += record.effects().bytes();
            if fits > 0 && bytes > max_bytes {
                break;
            }
            fits += 1;
        }
        records.truncate(fits);
        Ok(records)
    }

    fn newest(&self, uid: Uid) -> Result<u64, LogError> {
        self.come_back();
        Ok(self.stream.newest(uid).revision)
    }

    fn is_shared(&self) -> bool {
        true
    }
}
