//! The journal on the other machine.

use std::sync::{
    Arc,
    atomic::{AtomicBool, Ordering::Relaxed},
};

use futures_util::{FutureExt, StreamExt, stream};
use parking_lot::Mutex;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::sync::{Semaphore, SemaphorePermit, mpsc, oneshot, watch};
use wayfold_server::log::{
    Effects, Journal, LogError, Origin, Receipt, Record, RecordStream, Retention, Tip, Uid, Window,
};

/// The messages of all indices in the order of their arrival, and the chance that a request or its answer is lost.
pub(crate) struct Stream {
    messages: Mutex<Vec<(Uid, Arc<Record>)>>,
    length: watch::Sender<usize>,
    random: Mutex<ChaCha8Rng>,
    loses: f64,
    /// True while no request reaches it.
    pub(super) is_cut: AtomicBool,
}

impl Stream {
    pub(crate) fn new(seed: u64, loses: f64) -> Arc<Self> {
        Arc::new(Self {
            messages: Mutex::default(),
            length: watch::Sender::new(0),
            random: Mutex::new(ChaCha8Rng::seed_from_u64(seed)),
            loses,
            is_cut: AtomicBool::new(false),
        })
    }

    pub(crate) fn records(&self, uid: Uid) -> Vec<Arc<Record>> {
        let messages = self.messages.lock();
        let records = messages.iter().filter(|(of, _)| *of == uid);
        records.map(|(_, record)| Arc::clone(record)).collect()
    }

    fn is_lost(&self) -> bool {
        self.is_cut.load(Relaxed) || self.random.lock().random_bool(self.loses)
    }

    fn publish(&self, uid: Uid, record: &Arc<Record>) -> Result<(), LogError> {
        let unconfirmed = LogError::Unconfirmed {
            uid,
            revision: record.revision(),
            what: "the connection was cut".into(),
        };
        if self.is_lost() {
            return Err(unconfirmed);
        }
        let mut messages = self.messages.lock();
        let newest = messages.iter().rfind(|(of, _)| *of == uid);
        let newest = newest.map_or(START, |(_, newest)| newest.tip());
        if !record.follows(newest) {
            return Err(LogError::Fenced {
                uid,
                expected: record.revision() - 1,
                head: newest.revision,
            });
        }
        messages.push((uid, Arc::clone(record)));
        self.length.send_replace(messages.len());
        if self.is_lost() {
            Err(unconfirmed)
        } else {
            Ok(())
        }
    }
}

pub(super) const START: Tip = Tip {
    revision: Origin::START.revision,
    digest: Origin::START.digest,
};

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
}

impl Remote {
    pub(super) fn connect(stream: &Arc<Stream>) -> Arc<Self> {
        let (submissions, mut waiting) = mpsc::unbounded_channel::<Submission>();
        let turns = Arc::new(Semaphore::new(Semaphore::MAX_PERMITS));
        let remote = Arc::new(Self {
            stream: Arc::clone(stream),
            submissions,
            turns: Arc::clone(&turns),
            is_behind: watch::Sender::new(false),
        });
        let stream = Arc::clone(stream);
        tokio::spawn(async move {
            while let Some((uid, record, answer)) = waiting.recv().await {
                turns.acquire().await.unwrap().forget();
                let foreign = Arc::new(Record::after(START, Effects::new(1)));
                stream.messages.lock().push((Uid::unique(), foreign));
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

    fn follow(&self, uid: Uid, after: u64) -> RecordStream {
        let stream = Arc::clone(&self.stream);
        let is_behind = self.is_behind.subscribe();
        let position = (stream.length.subscribe(), after);
        let batches = stream::unfold(position, move |(mut length, after)| {
            let (stream, mut is_behind) = (Arc::clone(&stream), is_behind.clone());
            async move {
                loop {
                    is_behind.wait_for(|is_behind| !is_behind).await.ok()?;
                    length.borrow_and_update();
                    let mut records = stream.records(uid);
                    records.retain(|record| record.revision() > after);
                    if let Some(last) = records.last().map(|last| last.revision())
                        && !*is_behind.borrow()
                    {
                        return Some((Ok(records), (length, last)));
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
        _max_bytes: usize,
    ) -> Result<Vec<Arc<Record>>, LogError> {
        let mut records = self.stream.records(uid);
        self.come_back();
        records.retain(|record| after.is_none_or(|after| record.revision() > after));
        Ok(records)
    }

    fn trim(&self, _uid: Uid, _retention: &Retention) -> Result<(), LogError> {
        Ok(())
    }

    fn window(&self, _uid: Uid) -> Result<Window, LogError> {
        Ok(Window::default())
    }
}
