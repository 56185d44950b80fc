//! The expected state of an index, the same for every store.

use std::{
    collections::BTreeMap,
    sync::Arc,
    time::{Duration, SystemTime},
};

use bytes::Bytes;
use wayfold_server::log::{
    Batch, Block, Effects, LogError, Operation, Origin, Record, Retention, Session, Sessions,
    StoredPoint, Uid, View, Window,
};

use crate::{Engine, all_points, effects};

pub(crate) type Points = BTreeMap<u64, Arc<StoredPoint>>;

/// A batch of the session with this place among the open ones; of a new session if there is none.
#[derive(Clone, Copy, Debug)]
pub(crate) struct NextBatch {
    pub(crate) of: usize,
    pub(crate) reserve: u64,
    /// Ends another session.
    pub(crate) end: bool,
}

/// The content of an index after a record.
#[derive(Clone, Debug, Default)]
pub(crate) struct Sum {
    pub(crate) points: Points,
    pub(crate) next_id: u64,
    /// The newest batch of each session, and the time of its record.
    sessions: BTreeMap<u64, (Arc<Batch>, u64)>,
    /// The session that reserved an id.
    owners: BTreeMap<u64, u64>,
}

/// The expected state of an index: its points after each of its records, and the records that are kept.
pub(crate) struct Model {
    origin: Origin,
    pub(crate) records: Vec<Arc<Record>>,
    /// The sums after the origin and after each record.
    sums: Vec<Sum>,
    pub(crate) trimmed: usize,
    pub(crate) operations_trimmed: usize,
    /// The number of records that are certainly durable.
    pub(crate) synced: usize,
}

impl Model {
    pub(crate) fn new(origin: Origin, sum: Sum) -> Self {
        Self {
            origin,
            records: Vec::new(),
            sums: vec![sum],
            trimmed: 0,
            operations_trimmed: 0,
            synced: 0,
        }
    }

    /// The position and the sum of the index at its origin.
    pub(crate) fn origin(&self) -> (Origin, &Sum) {
        (self.origin, &self.sums[0])
    }

    /// The sum after this many records.
    pub(crate) fn sum_after(&self, records: usize) -> &Sum {
        &self.sums[records]
    }

    pub(crate) fn head(&self) -> u64 {
        self.origin.revision + self.records.len() as u64
    }

    pub(crate) fn newest(&self) -> &Sum {
        self.sums.last().unwrap()
    }

    pub(crate) fn digest(&self) -> [u8; 32] {
        self.records
            .last()
            .map_or(self.origin.digest, |last| *last.digest())
    }

    /// The effects of the next record.
    pub(crate) fn next(
        &self,
        store: &[u64],
        remove: &[u64],
        operation: usize,
        batch: Option<NextBatch>,
    ) -> Effects {
        let revision = self.head() + 1;
        let present = |id: &u64| self.newest().points.contains_key(id);
        let remove: Vec<u64> = remove.iter().copied().filter(present).collect();
        let mut effects = effects(revision, store, &remove);
        effects.set_operation((operation > 0).then(|| {
            Arc::new(Operation {
                id: format!("operation {revision}"),
                fingerprint: [revision as u8; 32],
                response: vec![7; operation].into(),
            })
        }));
        effects.set_batch(batch.map(|next| Arc::new(self.batch(next, effects.next_id()))));
        effects
    }

    fn batch(&self, next: NextBatch, stored: u64) -> Batch {
        let NextBatch { of, reserve, end } = next;
        let sum = self.newest();
        let revision = self.head() + 1;
        let of = sum.sessions.values().map(|(batch, _)| batch).nth(of);
        let (session, number) = of.map_or((revision, 0), |batch| (batch.session, batch.number + 1));
        let ended = sum.sessions.keys().copied().find(|&id| id != session);
        let first = sum.next_id.max(stored);
        Batch {
            session,
            number,
            fingerprint: [revision as u8; 32],
            response: Bytes::from(format!("batch {number}")),
            reserved: if reserve == 0 {
                0..0
            } else {
                first..first + reserve
            },
            ended: ended.into_iter().filter(|_| end).collect(),
        }
    }

    /// Adds the next record, which must have these effects.
    pub(crate) fn append(&mut self, record: Arc<Record>, effects: &Effects) {
        assert_eq!(record.revision(), self.head() + 1);
        assert_eq!(record.effects(), effects);
        assert_eq!(*record.previous(), self.digest());
        let mut sum = self.newest().clone();
        for id in effects.removed() {
            sum.points.remove(id);
        }
        for point in effects.stored().iter() {
            let revision = record.revision();
            let stored = StoredPoint {
                id: point.id,
                revision,
                modified: revision,
                tag: revision,
                state: Box::new([revision as f64]),
                payload: Bytes::from(format!("{} at {revision}", point.id)),
            };
            sum.points.insert(point.id, Arc::new(stored));
            sum.next_id = sum.next_id.max(point.id + 1);
        }
        if let Some(batch) = effects.batch() {
            for ended in &batch.ended {
                sum.sessions.remove(ended);
                sum.owners.retain(|_, owner| owner != ended);
            }
            let newest = (Arc::clone(batch), record.time_ms());
            sum.sessions.insert(batch.session, newest);
            for id in batch.reserved.clone() {
                sum.owners.insert(id, batch.session);
                sum.next_id = sum.next_id.max(id + 1);
            }
        }
        self.sums.push(sum);
        self.records.push(record);
    }

    fn operations(&self) -> Vec<Arc<Operation>> {
        let operations = self
            .records
            .iter()
            .map(|record| record.effects().operation());
        operations.flatten().cloned().collect()
    }

    pub(crate) fn trim(&mut self, retention: &Retention) {
        let time =
            |record: &Record| SystemTime::UNIX_EPOCH + Duration::from_millis(record.time_ms());
        let bytes = |records: &[Arc<Record>]| -> usize {
            records.iter().map(|record| record.effects().bytes()).sum()
        };
        while let held = &self.records[self.trimmed..]
            && held.len() > 1
            && (bytes(held) > retention.record_bytes || time(&held[0]) < retention.since)
        {
            self.trimmed += 1;
        }
        let operations = self.operations();
        let bytes = |operations: &[Arc<Operation>]| -> usize {
            operations.iter().map(|operation| operation.bytes()).sum()
        };
        while let held = &operations[self.operations_trimmed..]
            && held.len() > 1
            && (held.len() > retention.operations || bytes(held) > retention.operation_bytes)
        {
            self.operations_trimmed += 1;
        }
    }

    /// Follows a log that was reopened: trimmed records may have come back. `unknown` are the effects of a failed
    /// append.
    pub(crate) fn rejoin(&mut self, log: &dyn Engine, uid: Uid, unknown: Option<&Effects>) {
        let revision = log.view(uid).unwrap().revision();
        let held = log.read(uid, None, usize::MAX).unwrap();
        if revision == self.head() + 1 {
            let unknown = unknown.expect("nobody appended it");
            self.append(Arc::clone(held.last().unwrap()), unknown);
        }
        let left = (revision - self.origin.revision) as usize;
        assert!((self.synced..=self.records.len()).contains(&left), "{left}");
        self.records.truncate(left);
        self.sums.truncate(left + 1);
        self.synced = left;
        let trimmed = left - held.len();
        assert!(trimmed <= self.trimmed, "{trimmed} of {}", self.trimmed);
        self.trimmed = trimmed;
        let operations = self.operations().len();
        let trimmed = operations - log.operations(uid).unwrap().len();
        assert!(trimmed <= self.operations_trimmed);
        self.operations_trimmed = trimmed;
    }

    /// Checks everything that a log shows of the index.
    pub(crate) fn check(&self, log: &dyn Engine, uid: Uid) {
        let view = log.view(uid).unwrap();
        assert_eq!(view.revision(), self.head());
        check_view(&*view, self.newest());
        assert_eq!(
            log.read(uid, None, usize::MAX).unwrap(),
            self.records[self.trimmed..]
        );
        let held = &self.records[self.trimmed..];
        let bytes = held.iter().map(|record| record.effects().bytes() as u64);
        let window = Window {
            records: held.len() as u64,
            bytes: bytes.sum(),
        };
        assert_eq!(log.window(uid).unwrap(), window);
        let oldest = self.origin.revision + self.trimmed as u64;
        for after in self.origin.revision.saturating_sub(1)..=self.head() {
            let tail = log.read(uid, Some(after), usize::MAX);
            if after < oldest {
                assert_eq!(tail, Err(LogError::Trimmed { uid, after, oldest }));
            } else {
                let skipped = (after - self.origin.revision) as usize;
                let rest = &self.records[skipped..];
                assert_eq!(tail.unwrap(), rest);
                for most in [0, 600, 1500] {
                    let part = log.read(uid, Some(after), most).unwrap();
                    let bytes = |count: usize| -> usize {
                        let records = rest[..count].iter();
                        records.map(|record| record.effects().bytes()).sum()
                    };
                    let fits = (0..=rest.len()).rev().find(|&count| bytes(count) <= most);
                    let count = fits.unwrap_or(0).max(1).min(rest.len());
                    assert_eq!(part, rest[..count]);
                }
            }
        }
        let operations = self.operations();
        assert_eq!(
            log.operations(uid).unwrap(),
            operations[self.operations_trimmed..]
        );
    }
}

impl Sum {
    /// The sessions, to restore them: each id is a block of its own.
    pub(crate) fn sessions(&self) -> Sessions {
        let mut sessions = Sessions::default();
        for (&id, (batch, used_ms)) in &self.sessions {
            sessions.insert(id, session(batch, *used_ms));
        }
        for (&id, &session) in &self.owners {
            sessions.insert_block(
                id,
                Block {
                    end: id + 1,
                    session,
                },
            );
        }
        sessions
    }
}

fn session(batch: &Batch, used_ms: u64) -> Session {
    Session {
        batch: batch.number,
        fingerprint: batch.fingerprint,
        response: batch.response.clone(),
        used_ms,
    }
}

pub(crate) fn check_view(view: &dyn View, sum: &Sum) {
    assert_eq!(view.next_id(), sum.next_id);
    assert_eq!(all_points(view), sum.points);
    for id in 0..13 {
        assert_eq!(view.get(id).unwrap().as_ref(), sum.points.get(&id));
    }
    let sessions = view.sessions().iter();
    let sessions: Vec<_> = sessions
        .map(|(id, session)| (id, (**session).clone()))
        .collect();
    let expected = sum.sessions.iter();
    let expected = expected.map(|(&id, (batch, used_ms))| (id, session(batch, *used_ms)));
    assert_eq!(sessions, expected.collect::<Vec<_>>());
    for id in 0..=sum.next_id {
        assert_eq!(view.sessions().owner(id), sum.owners.get(&id).copied());
    }
}
