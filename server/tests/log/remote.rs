//! A log whose journal is on another machine: one server's connection to it, with a point store and a catalogue of its
//! own. It does what the apply loop of a server does: it sends a record again if its answer was lost, and applies what
//! the journal sends.

#[path = "../service/remote/stream.rs"]
#[expect(
    dead_code,
    reason = "only the suite of the service delays and cuts requests"
)]
mod stream;

use std::{
    collections::VecDeque,
    sync::Arc,
    time::{Duration, UNIX_EPOCH},
};

use parking_lot::Mutex;
use tokio::runtime::{Builder, Runtime};
use wayfold_server::log::{
    Catalogue, Entry, Journal, LogError, MemoryLog, Operation, Origin, PointStore, PointWriter,
    Receipt, Record, RecordPosition, RecordStream, Retention, Uid, View, Window, connect_nats,
};

use crate::{nats::NatsServer, next};
use stream::{Remote, Stream};

/// The maximum number of times that a record is sent.
const MAX_SENDS: usize = 1000;

/// The other machine.
enum Machine {
    /// A part of the test.
    Stream(Arc<Stream>),
    /// A server of NATS.
    Nats(NatsServer),
}

impl Machine {
    /// A connection to it.
    fn connect(&self, runtime: &Runtime) -> Arc<dyn Journal> {
        let _entered = runtime.enter();
        match self {
            Machine::Stream(stream) => Remote::connect(stream),
            Machine::Nats(server) => {
                let log = connect_nats(&server.options(), Arc::new(MemoryLog::new()));
                log.unwrap().0.journal
            }
        }
    }
}

/// See the module.
pub(crate) struct RemoteLog {
    runtime: Runtime,
    machine: Machine,
    connection: Arc<dyn Journal>,
    local: MemoryLog,
    /// Held while records are applied, so that each caller applies the next ones.
    applying: Mutex<()>,
}

impl RemoteLog {
    /// A log whose journal loses messages with this chance.
    pub(crate) fn new(seed: u64, loses: f64) -> Self {
        Self::over(Machine::Stream(Stream::new(seed, loses)))
    }

    /// A log whose journal is in a server of NATS of its own.
    pub(crate) fn in_nats() -> Self {
        Self::over(Machine::Nats(NatsServer::start()))
    }

    fn over(machine: Machine) -> Self {
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build();
        let runtime = runtime.unwrap();
        Self {
            connection: machine.connect(&runtime),
            runtime,
            machine,
            local: MemoryLog::new(),
            applying: Mutex::new(()),
        }
    }

    /// Replaces the connection by a new one.
    pub(crate) fn reconnect(&mut self) {
        self.connection = self.machine.connect(&self.runtime);
    }

    /// True if the journal has this record.
    fn has(&self, uid: Uid, record: &Record) -> bool {
        let found = self.connection.read(uid, Some(record.revision() - 1), 1);
        found.is_ok_and(|found| found.first().is_some_and(|it| **it == *record))
    }

    /// Applies all records that the journal has.
    fn catch_up(&self, uid: Uid) -> Result<(), LogError> {
        let _applying = self.applying.lock();
        let mut revision = PointStore::view(&self.local, uid)?.revision();
        let newest = self.connection.newest(uid)?;
        let mut records = self.connection.follow(uid, revision);
        while revision < newest {
            let batch = next(&mut records)?;
            revision = self.local.apply(uid, &batch)?.revision();
        }
        Ok(())
    }
}

impl Stream {
    /// Trims the records up to the revision `applied`.
    fn trim(&self, uid: Uid, retention: &Retention, applied: u64) {
        let mut held = VecDeque::from(self.after(uid, None).unwrap());
        let bytes = held.iter().map(|record| record.effects().bytes());
        let mut bytes: usize = bytes.sum();
        let is_old = |record: &Record| {
            UNIX_EPOCH + Duration::from_millis(record.time_ms()) < retention.since
        };
        while held.len() > 1
            && held[0].revision() <= applied
            && (bytes > retention.record_bytes || is_old(&held[0]))
        {
            bytes -= held[0].effects().bytes();
            self.trimmed.lock().insert(uid, held[0].revision());
            held.pop_front();
        }
    }
}

impl Journal for RemoteLog {
    fn submit(&self, uid: Uid, record: Arc<Record>) -> Result<Receipt, LogError> {
        self.local.view(uid)?;
        for _ in 0..MAX_SENDS {
            let receipt = self.connection.submit(uid, Arc::clone(&record))?;
            let Receipt::Awaited(outcome) = receipt else {
                panic!("a journal elsewhere accepts nothing at once");
            };
            let outcome = self.runtime.block_on(outcome);
            // Whatever the answer was, the journal has the record once it sends it.
            if outcome.is_ok() || self.has(uid, &record) {
                return Ok(Receipt::Accepted);
            }
            if let Err(why) = outcome
                && !matches!(why, LogError::Unconfirmed { .. })
            {
                return Err(why);
            }
        }
        panic!("the journal is cut off");
    }

    fn follow(&self, uid: Uid, after: u64) -> RecordStream {
        self.connection.follow(uid, after)
    }

    fn read(
        &self,
        uid: Uid,
        after: Option<u64>,
        max_bytes: usize,
    ) -> Result<Vec<Arc<Record>>, LogError> {
        self.local.view(uid)?;
        self.connection.read(uid, after, max_bytes)
    }

    fn newest(&self, uid: Uid) -> Result<u64, LogError> {
        self.connection.newest(uid)
    }
}

impl PointStore for RemoteLog {
    fn apply(&self, uid: Uid, records: &[Arc<Record>]) -> Result<Arc<dyn View>, LogError> {
        self.local.apply(uid, records)
    }

    fn view(&self, uid: Uid) -> Result<Arc<dyn View>, LogError> {
        self.catch_up(uid)?;
        self.local.view(uid)
    }

    /// Only what is applied here may be forgotten.
    fn trim(&self, uid: Uid, retention: &Retention) -> Result<(), LogError> {
        let applied = self.local.view(uid)?.revision();
        if let Machine::Stream(stream) = &self.machine {
            stream.trim(uid, retention, applied);
        }
        self.local.trim(uid, retention)
    }

    fn window(&self, uid: Uid) -> Result<Window, LogError> {
        let held = self.connection.read(uid, None, usize::MAX)?;
        let bytes = held.iter().map(|record| record.effects().bytes() as u64);
        Ok(Window {
            records: held.len() as u64,
            bytes: bytes.sum(),
        })
    }

    fn operations(&self, uid: Uid) -> Result<Vec<Arc<Operation>>, LogError> {
        self.local.operations(uid)
    }

    fn restore(
        &self,
        entry: Entry,
        origin: Origin,
        replaces: bool,
    ) -> Result<Box<dyn PointWriter>, LogError> {
        let position = RecordPosition {
            revision: origin.revision,
            digest: origin.digest,
        };
        if let Machine::Stream(stream) = &self.machine {
            stream.origins.lock().insert(entry.uid, position);
        }
        self.local.restore(entry, origin, replaces)
    }
}

impl Catalogue for RemoteLog {
    fn indexes(&self) -> Result<Vec<Entry>, LogError> {
        self.local.indexes()
    }

    fn create(&self, entry: Entry) -> Result<(), LogError> {
        self.local.create(entry)
    }

    fn delete(&self, uid: Uid) -> Result<(), LogError> {
        self.local.delete(uid)
    }
}
