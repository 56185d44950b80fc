//! A client that writes and keeps a ledger of the acknowledged mutations.

mod requests;

use std::time::Instant;

use prost::bytes::Bytes;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::sync::watch;
use tonic::{Code, Status};
use wayfold_proto::v1::{
    IdBlock, InsertRequest, InsertResponse, OpenSessionRequest, OpenSessionResponse, RemoveRequest,
    RemoveResponse, Revision, StepKind, UpdateRequest, UpdateResponse, WriteRequest, WriteResponse,
};
use wayfold_tests::{Refusal, States, Stubs, ledger::Entry, row_states};

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
    /// The newest batch of the session that it has left, and the answer.
    left: Option<Batch>,
    /// The points that other writers change too, if there are any.
    contested: Option<Contested>,
    unknown: Option<(Request, Instant)>,
    /// The refusal of that mutation, if it was refused.
    pub(crate) refusal: Option<Status>,
    /// The acknowledged mutations since they were last taken.
    pub(crate) ledger: Vec<Acknowledged>,
    /// The compare-and-sets that were refused because their points had changed.
    pub(crate) conflicts: Vec<Conflict>,
}

/// An acknowledged mutation.
pub(crate) struct Acknowledged {
    pub(crate) entry: Entry,
    /// The time before its first attempt.
    pub(crate) invoked: Instant,
    /// The time after the answer.
    pub(crate) returned: Instant,
}

/// A compare-and-set that was refused because its point had changed.
pub(crate) struct Conflict {
    pub(crate) request: UpdateRequest,
    /// The time before its first attempt.
    pub(crate) invoked: Instant,
    /// The time after the refusal.
    pub(crate) returned: Instant,
}

#[derive(Clone)]
enum Request {
    Insert(Box<InsertRequest>),
    Remove(RemoveRequest),
    Update(UpdateRequest),
    OpenSession(OpenSessionRequest),
    Write(Box<WriteRequest>),
    /// A batch that was acknowledged: it gets the same answer again.
    Repeat(Batch),
}

/// A batch of a session and its answer.
type Batch = Box<(WriteRequest, WriteResponse)>;

/// A writer session.
struct Session {
    uid: String,
    id: u64,
    batch: u64,
    /// The reserved ids that were not used yet.
    ids: Vec<u64>,
    /// The newest batch that was acknowledged.
    newest: Option<Batch>,
}

impl Session {
    fn take_over(&mut self, block: Option<IdBlock>) {
        let IdBlock { first_id, id_count } = block.expect("a block");
        self.ids.extend((0..id_count).map(|at| first_id + at));
    }
}

/// All writers change these points, and nobody removes them.
struct Contested {
    uid: String,
    ids: Vec<u64>,
    /// The revision at which the writer has read them last, or that stored them.
    seen: u64,
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
            left: None,
            contested: None,
            unknown: None,
            refusal: None,
            ledger: Vec::new(),
            conflicts: Vec::new(),
        }
    }

    /// Opens a session, in which it writes from now on.
    pub(crate) async fn open_session(&mut self, stubs: &mut Stubs, uid: &str) {
        let request = Request::OpenSession(self.opening(uid));
        let is_open = self.send(stubs, request, Instant::now()).await;
        assert!(is_open, "{:?}", self.refusal);
    }

    /// Stores points that all writers are to change.
    pub(crate) async fn store_contested(
        &mut self,
        stubs: &mut Stubs,
        count: usize,
    ) -> InsertResponse {
        let payloads = (0..count).map(|row| self.payload(&format!("contested/{row}"), 0));
        let payloads = payloads.collect();
        let request = InsertRequest {
            index_name: "arm".into(),
            states: Some(row_states(&self.states.rows(count), COORDINATES)),
            tags: vec![self.name; count],
            payloads,
            operation_id: "contested".into(),
            ..Default::default()
        };
        let invoked = Instant::now();
        let response = stubs.insert(request.clone()).await;
        self.note(Entry::Insert(request, response.clone()), invoked);
        response
    }

    /// From now on it changes these points too, by compare-and-set and in the batches of its session, and leaves each
    /// session after some batches.
    pub(crate) fn compete(&mut self, stored: &InsertResponse) {
        let Revision { uid, number } = stored.revision.clone().expect("a revision");
        self.contested = Some(Contested {
            uid,
            ids: stored.ids.clone(),
            seen: number,
        });
    }

    /// The ids of these points.
    pub(crate) fn contested_ids(&self) -> &[u64] {
        match &self.contested {
            Some(contested) => &contested.ids,
            None => &[],
        }
    }

    /// The revision at which it has read them; 0 if there are none.
    pub(crate) fn seen(&self) -> u64 {
        self.contested.as_ref().map_or(0, |it| it.seen)
    }

    /// It has read these points at this revision, with which its next compare-and-sets compare.
    pub(crate) fn has_seen(&mut self, revision: u64) {
        if let Some(contested) = &mut self.contested {
            contested.seen = revision;
        }
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
            Request::Update(update) => Entry::Update(update, UpdateResponse::default()),
            Request::OpenSession(open) => Entry::OpenSession(open, OpenSessionResponse::default()),
            Request::Write(write) => Entry::Write(*write, WriteResponse::default()),
            Request::Repeat(_) => return None,
        };
        Some((entry, invoked))
    }

    /// The ids of points that it has stored and not removed.
    pub(crate) fn stored_ids(&self) -> &[u64] {
        &self.mine
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

    /// Returns true if the mutation was acknowledged, or refused because a point had changed; otherwise its outcome is
    /// unknown.
    async fn send(&mut self, stubs: &mut Stubs, request: Request, invoked: Instant) -> bool {
        let points = &mut stubs.points;
        let answered = match &request {
            Request::Insert(insert) => {
                let answered = points.insert(InsertRequest::clone(insert)).await;
                answered.map(|response| {
                    Entry::Insert(InsertRequest::clone(insert), response.into_inner())
                })
            }
            Request::Remove(remove) => {
                let answered = points.remove(remove.clone()).await;
                answered.map(|response| Entry::Remove(remove.clone(), response.into_inner()))
            }
            Request::Update(update) => {
                let answered = points.update(update.clone()).await;
                answered.map(|response| Entry::Update(update.clone(), response.into_inner()))
            }
            Request::OpenSession(open) => {
                let answered = points.open_session(open.clone()).await;
                answered.map(|response| Entry::OpenSession(open.clone(), response.into_inner()))
            }
            Request::Write(write) => {
                let answered = points.write(WriteRequest::clone(write)).await;
                answered
                    .map(|response| Entry::Write(WriteRequest::clone(write), response.into_inner()))
            }
            Request::Repeat(batch) => {
                let (write, acknowledged) = &**batch;
                match points.write(write.clone()).await {
                    Ok(response) => {
                        assert_eq!(response.into_inner(), *acknowledged, "another answer");
                        self.refusal = None;
                        return true;
                    }
                    Err(status) => Err(status),
                }
            }
        };
        match answered {
            Ok(entry) => {
                self.refusal = None;
                self.acknowledged(entry, invoked);
                true
            }
            Err(status) => self.refused(request, invoked, status),
        }
    }

    fn acknowledged(&mut self, entry: Entry, invoked: Instant) {
        match &entry {
            Entry::Insert(insert, response) if entry.changed() => {
                self.stored(&insert.payloads, &response.ids);
                self.last_insert = Some(InsertRequest {
                    ids: response.ids.clone(),
                    ..insert.clone()
                });
            }
            Entry::OpenSession(open, response) => self.enter(&open.uid, response),
            Entry::Write(write, response) => {
                let steps = write.kinds().zip(&write.ids);
                let puts = steps.filter(|(kind, _)| *kind == StepKind::Put);
                let puts: Vec<u64> = puts.map(|(_, id)| *id).collect();
                self.stored(&write.payloads, &puts);
                if let Some(session) = &mut self.session {
                    session.take_over(response.reserved);
                    session.newest = Some(Box::new((write.clone(), response.clone())));
                }
            }
            _ => {}
        }
        self.note(entry, invoked);
    }

    /// Returns true if the refusal is the outcome.
    fn refused(&mut self, request: Request, invoked: Instant, status: Status) -> bool {
        let is_conflict = status.code() == Code::FailedPrecondition
            && Refusal::of(&status).reason == "REVISION_CONFLICT";
        match request {
            Request::Update(request) if is_conflict => {
                self.refusal = None;
                self.conflicts.push(Conflict {
                    request,
                    invoked,
                    returned: Instant::now(),
                });
                true
            }
            request => {
                self.unknown = Some((request, invoked));
                self.refusal = Some(status);
                false
            }
        }
    }

    /// Goes on in a session that was opened.
    fn enter(&mut self, uid: &str, opened: &OpenSessionResponse) {
        let mut session = Session {
            uid: uid.to_owned(),
            id: opened.session,
            batch: 0,
            ids: Vec::new(),
            newest: None,
        };
        session.take_over(opened.reserved);
        let left = self.session.replace(session);
        self.left = left.and_then(|left| left.newest);
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
