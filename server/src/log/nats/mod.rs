//! The log of several servers: its journal is in the streams of NATS JetStream, its catalogue is a bucket of NATS, and
//! each server has a point store of its own.
//!
//! An index is a subject of a stream. A pack of consecutive records is published with the sequence number of the message
//! before it on the subject: NATS takes it only if that is the newest. So of two servers that submit after the same
//! revision one wins. The streams keep a record until enough servers store what it
//! did ([`Journal::forget`]), and the newest message of an index always, because the next one names it.
//!
//! Nothing that comes from a stream is trusted: a record is decoded only if it matches its checksum, and the apply loop
//! checks that it follows the record before it.

mod catalogue;
mod connection;
mod follow;
mod message;
mod publisher;
mod settings;
mod tail;

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use async_nats::connection::State;
use futures_util::{FutureExt, future::BoxFuture};
use parking_lot::Mutex;
use thiserror::Error;
use tokio::{
    runtime::Handle,
    sync::{mpsc::UnboundedSender, oneshot},
};

use self::{
    catalogue::NatsCatalogue, connection::Connection, message::PackPosition, publisher::Submission,
};
use super::{
    Catalogue, Effects, Journal, Log, LogError, PointStore, Receipt, Record, RecordPosition,
    RecordStream, Uid, record::stored_bytes,
};

/// The time between two attempts of a follower to read a stream.
const RETRY_INTERVAL: Duration = Duration::from_millis(200);

/// The most bytes of records that are read at a time to repair a stream.
const REPAIR_BYTES: usize = 4 * 1024 * 1024;

/// The servers of NATS, and what Wayfold keeps there.
#[derive(Clone, Debug)]
pub struct NatsOptions {
    /// The URLs of the servers, separated by commas.
    pub servers: String,
    /// The prefix of the streams and the bucket.
    pub name: String,
    /// The number of NATS servers that store each record.
    pub replicas: usize,
    /// The least `max_payload` of NATS, more than the headers of a message take.
    pub min_payload: usize,
    /// The file of the credentials, if NATS asks for them.
    pub credentials: Option<std::path::PathBuf>,
    /// The file of the authorities of NATS's certificates, if its servers have TLS.
    pub ca: Option<std::path::PathBuf>,
}

/// The error of a start with a journal in NATS.
#[derive(Debug, Error)]
pub enum NatsError {
    /// The credentials cannot be read.
    #[error("cannot read the credentials for NATS, {file} (cluster.credentials): {source}")]
    Credentials {
        /// The file.
        file: String,
        /// The problem.
        source: std::io::Error,
    },
    /// No server of NATS answers.
    #[error(
        "cannot reach NATS at {servers} (cluster.nats): {what}; start it with JetStream (nats-server --jetstream)"
    )]
    Unreachable {
        /// The URLs.
        servers: String,
        /// The problem.
        what: String,
    },
    /// NATS knows no such user.
    #[error(
        "NATS at {servers} does not let this server in: {what}; set cluster.credentials to the file of a user of NATS, or \
         write the user and the password into the URL of cluster.nats"
    )]
    Unauthorized {
        /// The URLs.
        servers: String,
        /// NATS's answer.
        what: String,
    },
    /// The connection cannot be encrypted.
    #[error(
        "no TLS connection to NATS at {servers}: {what}; set cluster.ca (now {ca}) to the file in PEM of the authorities \
         that certify NATS, or to \"off\" if it has no TLS"
    )]
    Tls {
        /// The URLs.
        servers: String,
        /// The problem.
        what: String,
        /// The setting.
        ca: String,
    },
    /// NATS would lose or refuse records.
    #[error(
        "NATS would lose or refuse records: the stream {stream} has {}; undo that (nats stream edit {stream}), or, if NATS \
         does not let you, make the streams again: docs/cluster.md#reseed",
        faults.join(", ")
    )]
    UnfitStream {
        /// The stream.
        stream: String,
        /// Its settings that are wrong.
        faults: Vec<String>,
    },
    /// NATS takes only small messages.
    #[error(
        "NATS takes messages of up to {bytes} bytes: raise its max_payload to {least} at least"
    )]
    SmallMessages {
        /// Its `max_payload`.
        bytes: usize,
        /// The least that is enough.
        least: usize,
    },
    /// NATS has no stream or bucket for the records.
    #[error(
        "NATS cannot keep the {what}: {why}; it needs version 2.15 or newer, JetStream, and as many servers as \
         cluster.replicas says"
    )]
    Refused {
        /// The stream or bucket.
        what: String,
        /// NATS's answer.
        why: String,
    },
}

/// Connects to NATS, and makes a log of its streams and of the point store and the local catalogue of `local`. Returns the
/// connection too. Needs a runtime, and blocks.
pub fn connect<Store: PointStore + Catalogue + 'static>(
    options: &NatsOptions,
    local: Arc<Store>,
) -> Result<(Log, async_nats::Client), NatsError> {
    Handle::current().block_on(open(options, local))
}

/// Like [`connect`], without blocking.
pub(crate) async fn open<Store: PointStore + Catalogue + 'static>(
    options: &NatsOptions,
    local: Arc<Store>,
) -> Result<(Log, async_nats::Client), NatsError> {
    let runtime = Handle::current();
    let connection = Arc::new(Connection::open(options).await?);
    let catalogue = NatsCatalogue::open(Arc::clone(&connection), runtime.clone(), local.clone());
    let catalogue = Arc::new(catalogue.await?);
    let client = connection.context.client();
    let log = Log {
        catalogue: catalogue.clone(),
        journal: Arc::new(NatsJournal {
            connection,
            runtime,
            publishers: Mutex::default(),
            catalogue,
            local: local.clone(),
        }),
        points: local,
    };
    Ok((log, client))
}

/// The journal in NATS.
struct NatsJournal {
    connection: Arc<Connection>,
    runtime: Handle,
    publishers: Mutex<BTreeMap<Uid, UnboundedSender<Submission>>>,
    catalogue: Arc<NatsCatalogue>,
    /// The records that this server has applied, as far as it keeps them.
    local: Arc<dyn Journal>,
}

impl NatsJournal {
    /// Gives a record to the publisher of its index; `begins` says that the index begins with it at an origin.
    fn send(
        &self,
        uid: Uid,
        record: Arc<Record>,
        begins: bool,
    ) -> BoxFuture<'static, Result<(), LogError>> {
        let revision = record.revision();
        let (answer, outcome) = oneshot::channel();
        let mut submission = Submission {
            stored: record.encode(),
            record,
            begins,
            answer,
        };
        let mut publishers = self.publishers.lock();
        if !publishers.contains_key(&uid) {
            // Those that have ended may be of deleted indices.
            publishers.retain(|_, publisher| !publisher.is_closed());
        }
        let start = || publisher::start(uid, Arc::clone(&self.connection), &self.runtime);
        while let Err(back) = publishers.entry(uid).or_insert_with(start).send(submission) {
            submission = back.0;
            publishers.retain(|_, publisher| !publisher.is_closed());
        }
        drop(publishers);
        let lost = LogError::Unconfirmed {
            uid,
            revision,
            what: "the server stopped publishing".into(),
        };
        outcome.map(|outcome| outcome.unwrap_or(Err(lost))).boxed()
    }
}

impl Journal for NatsJournal {
    fn submit(&self, uid: Uid, record: Arc<Record>) -> Result<Receipt, LogError> {
        Ok(Receipt::Awaited(self.send(uid, record, false)))
    }

    fn check_size(&self, uid: Uid, effects: &Effects) -> Result<(), LogError> {
        let bytes = stored_bytes(effects);
        let max_bytes = message::max_stored_bytes(self.connection.max_payload);
        if bytes <= max_bytes {
            return Ok(());
        }
        Err(LogError::RecordTooLarge {
            uid,
            bytes,
            max_bytes,
        })
    }

    fn begin(&self, uid: Uid, record: Arc<Record>) -> Result<(), LogError> {
        self.runtime.block_on(self.send(uid, record, true))
    }

    fn follow(&self, uid: Uid, after: u64) -> RecordStream {
        follow::follow(Arc::clone(&self.connection), uid, after, None)
    }

    fn follow_applied(&self, uid: Uid, applied: RecordPosition) -> RecordStream {
        let RecordPosition { revision, digest } = applied;
        follow::follow(Arc::clone(&self.connection), uid, revision, Some(digest))
    }

    fn read(
        &self,
        uid: Uid,
        after: Option<u64>,
        max_bytes: usize,
    ) -> Result<Vec<Arc<Record>>, LogError> {
        let read = follow::read(&self.connection, uid, after, max_bytes);
        self.runtime.block_on(read)
    }

    fn oldest(&self, uid: Uid) -> Result<Option<u64>, LogError> {
        let first = self.runtime.block_on(self.connection.next(uid, 1))?;
        Ok(first.map(|(first, _)| first.first_revision))
    }

    fn newest(&self, uid: Uid) -> Result<u64, LogError> {
        let last = self.runtime.block_on(self.connection.last(uid))?;
        Ok(last.last_record.revision)
    }

    /// Every record is fenced by the one before it: if NATS has answered with stale data, or another server was first,
    /// nothing is published. A subject that NATS has lost whole begins again at the oldest record that this server keeps,
    /// fenced by its emptiness. A delete leaves such a subject too, so the catalogue is asked first.
    fn repair(&self, uid: Uid) -> Result<u64, LogError> {
        let newest = self.runtime.block_on(self.connection.last(uid))?;
        let mut position = newest.last_record;
        let (mut after, mut begins, mut repaired) = (position.revision, false, 0);
        if newest == PackPosition::START {
            if self.catalogue.is_deleted(uid)? {
                return Err(LogError::UnknownIndex { uid });
            }
            if let Some(oldest) = self.local.oldest(uid)? {
                (after, begins) = (oldest - 1, true);
            }
        }
        loop {
            let records = self.local.read(uid, Some(after), REPAIR_BYTES)?;
            let Some(last) = records.last().map(|last| last.position()) else {
                return Ok(repaired);
            };
            if !begins
                && records
                    .first()
                    .is_some_and(|first| !first.follows(position))
            {
                return Err(LogError::Contradicted {
                    uid,
                    revision: position.revision,
                    member: "another server".into(),
                });
            }
            let mut receipts = Vec::new();
            for record in records {
                receipts.push(self.send(uid, record, std::mem::take(&mut begins)));
            }
            for receipt in receipts {
                self.runtime.block_on(receipt)?;
                repaired += 1;
            }
            (position, after) = (last, last.revision);
        }
    }

    fn forget(&self, uid: Uid, up_to: u64) -> Result<(), LogError> {
        // After a copy this server keeps no record, so its window does not bound the revision.
        let oldest = self.local.oldest(uid)?.unwrap_or(u64::MAX);
        let up_to = up_to.min(oldest.saturating_sub(1));
        let forget = follow::forget(&self.connection, uid, up_to);
        self.runtime.block_on(forget)
    }

    fn is_reachable(&self) -> bool {
        let state = self.connection.context.client().connection_state();
        state == State::Connected
    }

    fn is_shared(&self) -> bool {
        true
    }
}
