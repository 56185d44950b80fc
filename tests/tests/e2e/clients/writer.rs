//! A client that writes and keeps a ledger of the acknowledged mutations.

use std::time::Instant;

use prost::bytes::Bytes;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::sync::watch;
use tonic::Status;
use wayfold_proto::v1::{
    IdBlock, InsertRequest, InsertResponse, OpenSessionRequest, RemoveRequest, RemoveResponse,
    StepKind, WriteRequest, WriteResponse,
};
use wayfold_tests::{States, Stubs, k_nearest, ledger::Entry, row_states};

use super::{COORDINATES, SPACE};

/// The calls that a writer sends.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Load {
    /// The maximum number of rows in one call.
    pub(crate) rows: usize,
    /// One call in this many carries large payloads.
    pub(crate) heavy: f64,
    /// One call in this many removes points.
    pub(crate) removals: f64,
}

/// The ids that a session reserves when it opens, and again whenever it has fewer.
const RESERVED_IDS: u64 = 64;

/// One call in this many finds nothing to change.
const IDLE_CALLS: u32 = 8;
/// Any two points are closer.
const ANY_SEPARATION: f64 = 1e9;

/// The bytes of a large payload, the maximum that is allowed.
const HEAVY_BYTES: usize = 64 * 1024;

/// A client that makes one mutation after another and remembers the one with an unknown outcome.
pub(crate) struct Writer {
    pub(crate) name: u64,
    load: Load,
    random: ChaCha8Rng,
    states: States,
    /// The bytes that fill large payloads: compression saves nothing.
    noise: Vec<u8>,
    calls: u64,
    mine: Vec<u64>,
    /// The ids of points with large payloads.
    heavy: Vec<u64>,
    /// The last insert, with the ids of its points, while all of them are stored.
    last_insert: Option<InsertRequest>,
    /// The session in which it writes, if it has one.
    session: Option<Session>,
    unknown: Option<(Request, Instant)>,
    /// The refusal of that mutation, if it was refused.
    pub(crate) refusal: Option<Status>,
    /// The acknowledged mutations since they were last taken.
    pub(crate) ledger: Vec<Acknowledged>,
}

/// An acknowledged mutation.
pub(crate) struct Acknowledged {
    pub(crate) entry: Entry,
    /// The time before its first attempt.
    pub(crate) invoked: Instant,
    /// The time after the answer.
    pub(crate) returned: Instant,
}

#[derive(Clone)]
enum Request {
    Insert(Box<InsertRequest>),
    Remove(RemoveRequest),
    Write(Box<WriteRequest>),
}

/// A writer session.
struct Session {
    uid: String,
    id: u64,
    batch: u64,
    /// The reserved ids that were not used yet.
    ids: Vec<u64>,
}

impl Session {
    fn take_over(&mut self, block: Option<IdBlock>) {
        let IdBlock { first_id, id_count } = block.expect("a block");
        self.ids.extend((0..id_count).map(|at| first_id + at));
    }
}

impl Writer {
    /// A client with this name; equal names and seeds make equal calls.
    pub(crate) fn new(name: u64, seed: u64, load: Load) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed + name);
        Self {
            name,
            load,
            noise: (0..HEAVY_BYTES).map(|_| random.random()).collect(),
            random,
            states: States::new(SPACE.parse().unwrap(), seed + name),
            calls: 0,
            mine: Vec::new(),
            heavy: Vec::new(),
            last_insert: None,
            session: None,
            unknown: None,
            refusal: None,
            ledger: Vec::new(),
        }
    }

    /// Opens a session, in which it writes from now on.
    pub(crate) async fn open_session(&mut self, stubs: &mut Stubs, uid: &str) {
        let request = OpenSessionRequest {
            index_name: "arm".into(),
            uid: uid.into(),
            reserve_count: RESERVED_IDS,
            ..Default::default()
        };
        let invoked = Instant::now();
        let opened = stubs.points.open_session(request.clone()).await;
        let response = opened.unwrap().into_inner();
        let session = self.session.insert(Session {
            uid: uid.into(),
            id: response.session,
            batch: 0,
            ids: Vec::new(),
        });
        session.take_over(response.reserved);
        self.note(Entry::OpenSession(request, response), invoked);
    }

    fn note(&mut self, entry: Entry, invoked: Instant) {
        self.ledger.push(Acknowledged {
            entry,
            invoked,
            returned: Instant::now(),
        });
    }

    /// The mutation of unknown outcome, with an empty answer, and the time before its first attempt.
    pub(crate) fn unknown(&self) -> Option<(Entry, Instant)> {
        let (request, invoked) = self.unknown.clone()?;
        let entry = match request {
            Request::Insert(insert) => Entry::Insert(*insert, InsertResponse::default()),
            Request::Remove(remove) => Entry::Remove(remove, RemoveResponse::default()),
            Request::Write(write) => Entry::Write(*write, WriteResponse::default()),
        };
        Some((entry, invoked))
    }

    /// The ids of points that it has stored and not removed.
    pub(crate) fn stored_ids(&self) -> &[u64] {
        &self.mine
    }

    fn next(&mut self) -> Request {
        self.calls += 1;
        if self.session.is_some() {
            return self.next_batch();
        }
        let operation_id = format!("{}-{}", self.name, self.calls);
        if let Some(last) = &self.last_insert
            && self.random.random_ratio(1, IDLE_CALLS)
        {
            return Request::Insert(Box::new(self.idle(last.clone(), operation_id)));
        }
        if self.random.random_bool(self.load.removals) {
            let ids = self.outdated();
            self.last_insert = None;
            if !ids.is_empty() {
                return Request::Remove(RemoveRequest {
                    index_name: "arm".into(),
                    ids,
                    operation_id,
                    ..Default::default()
                });
            }
        }
        let payloads = self.payloads();
        let (rows, heavy) = (payloads.len(), payloads[0].len() == HEAVY_BYTES);
        Request::Insert(Box::new(InsertRequest {
            index_name: "arm".into(),
            states: Some(row_states(&self.states.rows(rows), COORDINATES)),
            tags: vec![self.name; rows],
            payloads,
            neighbor_spec: heavy.then(|| k_nearest(3)),
            operation_id,
            ..Default::default()
        }))
    }

    /// An insert of points that are stored as they are, or of one that is too close to any other.
    fn idle(&mut self, last: InsertRequest, operation_id: String) -> InsertRequest {
        let repeats = self.random.random_bool(0.5);
        let insert = if repeats {
            last
        } else {
            InsertRequest {
                states: Some(row_states(&self.states.rows(1), COORDINATES)),
                tags: vec![self.name],
                payloads: vec![self.payload(&operation_id, 0)],
                min_separation: ANY_SEPARATION,
                ids: Vec::new(),
                ..last
            }
        };
        InsertRequest {
            operation_id,
            neighbor_spec: None,
            ..insert
        }
    }

    /// The next batch of the session: puts, removals and a tag.
    fn next_batch(&mut self) -> Request {
        let payloads = self.payloads();
        let mut removed = Vec::new();
        if self.random.random_bool(self.load.removals) {
            removed = self.outdated();
        }
        let tagged = self.mine.last().copied();
        let rows = self.states.rows(payloads.len());
        let session = self.session.as_mut().expect("a session");
        session.batch += 1;
        let puts = session.ids.split_off(session.ids.len() - payloads.len());
        let steps = [
            (StepKind::Remove, removed),
            (StepKind::Put, puts),
            (StepKind::SetTag, Vec::from_iter(tagged)),
        ];
        let steps = steps.into_iter();
        let steps =
            steps.flat_map(|(kind, ids)| ids.into_iter().map(move |id| (i32::from(kind), id)));
        let (kinds, ids): (Vec<i32>, Vec<u64>) = steps.unzip();
        Request::Write(Box::new(WriteRequest {
            index_name: "arm".into(),
            uid: session.uid.clone(),
            session: session.id,
            batch: session.batch,
            states: Some(row_states(&rows, COORDINATES)),
            tags: vec![self.calls; ids.len()],
            payloads,
            reserve_count: match (session.ids.len() as u64) < RESERVED_IDS {
                true => RESERVED_IDS,
                false => 0,
            },
            kinds,
            ids,
        }))
    }

    /// The payloads of the next rows. One call in some has large ones.
    fn payloads(&mut self) -> Vec<Bytes> {
        let heavy = self.random.random_bool(self.load.heavy);
        let (rows, bytes) = if heavy {
            (4, HEAVY_BYTES)
        } else {
            (self.random.random_range(1..=self.load.rows), 0)
        };
        let payload = |row| self.payload(&format!("{}-{}/{row}", self.name, self.calls), bytes);
        (0..rows).map(payload).collect()
    }

    /// Removes the large points, so that they do not pile up, or another point.
    fn outdated(&mut self) -> Vec<u64> {
        if !self.heavy.is_empty() {
            return std::mem::take(&mut self.heavy);
        }
        let count = self.mine.len();
        let one = (count > 0).then(|| self.random.random_range(0..count));
        Vec::from_iter(one.map(|at| self.mine.swap_remove(at)))
    }

    /// A unique payload of at least `bytes` bytes.
    fn payload(&self, text: &str, bytes: usize) -> Bytes {
        let noise = &self.noise[text.len().min(bytes)..bytes];
        [text.as_bytes(), noise].concat().into()
    }

    /// Makes up to `most` calls, and fewer if one is refused or the server ends, beginning with the mutation with the
    /// unknown outcome.
    pub(crate) async fn write(
        mut self,
        mut stubs: Stubs,
        acknowledged: watch::Sender<u64>,
        most: usize,
    ) -> Self {
        for _ in 0..most {
            let (request, invoked) = match self.unknown.take() {
                Some(unknown) => unknown,
                None => (self.next(), Instant::now()),
            };
            if !self.send(&mut stubs, request, invoked).await {
                return self;
            }
            acknowledged.send_modify(|count| *count += 1);
        }
        self
    }

    /// Resolves the unknown mutation by retries; it takes effect once.
    pub(crate) async fn resolve(&mut self, stubs: &mut Stubs) {
        let known = self.ask_again(stubs).await;
        assert!(known, "{:?}", self.refusal);
    }

    /// Retries the unknown mutation; false if its outcome is still unknown.
    pub(crate) async fn ask_again(&mut self, stubs: &mut Stubs) -> bool {
        match self.unknown.take() {
            Some((request, invoked)) => self.send(stubs, request, invoked).await,
            None => true,
        }
    }

    /// Returns true if the mutation was acknowledged; otherwise its outcome is unknown.
    async fn send(&mut self, stubs: &mut Stubs, request: Request, invoked: Instant) -> bool {
        let answered = match &request {
            Request::Insert(insert) => {
                let answered = stubs.points.insert(InsertRequest::clone(insert)).await;
                answered.map(|response| {
                    Entry::Insert(InsertRequest::clone(insert), response.into_inner())
                })
            }
            Request::Remove(remove) => {
                let answered = stubs.points.remove(remove.clone()).await;
                answered.map(|response| Entry::Remove(remove.clone(), response.into_inner()))
            }
            Request::Write(write) => {
                let answered = stubs.points.write(WriteRequest::clone(write)).await;
                answered
                    .map(|response| Entry::Write(WriteRequest::clone(write), response.into_inner()))
            }
        };
        let entry = match answered {
            Ok(entry) => entry,
            Err(status) => {
                self.unknown = Some((request, invoked));
                self.refusal = Some(status);
                return false;
            }
        };
        self.refusal = None;
        match &entry {
            Entry::Insert(insert, response) if entry.changed() => {
                self.stored(&insert.payloads, &response.ids);
                self.last_insert = Some(InsertRequest {
                    ids: response.ids.clone(),
                    ..insert.clone()
                });
            }
            Entry::Write(write, response) => {
                let steps = write.kinds().zip(&write.ids);
                let puts = steps.filter(|(kind, _)| *kind == StepKind::Put);
                let puts: Vec<u64> = puts.map(|(_, id)| *id).collect();
                self.stored(&write.payloads, &puts);
                if let Some(session) = &mut self.session {
                    session.take_over(response.reserved);
                }
            }
            _ => {}
        }
        self.note(entry, invoked);
        true
    }

    /// Remembers the ids of points that were stored.
    fn stored(&mut self, payloads: &[Bytes], ids: &[u64]) {
        let heavy = payloads[0].len() == HEAVY_BYTES;
        let stored = if heavy {
            &mut self.heavy
        } else {
            &mut self.mine
        };
        stored.extend(ids);
    }
}
