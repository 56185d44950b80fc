//! The next call of a writer.

use prost::bytes::Bytes;
use rand::{RngExt, seq::IndexedRandom};
use wayfold_proto::v1::{
    InsertRequest, OpenSessionRequest, RemoveRequest, StepKind, UpdateRequest, WriteRequest,
};
use wayfold_tests::{k_nearest, revision, row_states};

use super::{COORDINATES, HEAVY_BYTES, Request, Writer};

/// The ids that a session reserves when it opens, and again whenever it has fewer.
const RESERVED_IDS: u64 = 64;

/// One call in this many finds nothing to change.
const IDLE_CALLS: u32 = 8;
/// Any two points are closer.
const ANY_SEPARATION: f64 = 1e9;

/// One call in this many changes a point that other writers change too.
const CONTESTED_CALLS: u32 = 6;
/// A writer that competes leaves a session after this many batches.
const BATCHES_A_SESSION: u64 = 8;

impl Writer {
    pub(super) fn next(&mut self) -> Request {
        self.calls += 1;
        // The retry of an acknowledged batch changes nothing, at whichever server it arrives.
        if let Some(left) = self.left.take() {
            return Request::Repeat(left);
        }
        if let Some(session) = &self.session {
            if self.contested.is_some() && session.batch == BATCHES_A_SESSION {
                return Request::OpenSession(self.opening(&session.uid));
            }
            return self.next_batch();
        }
        let operation_id = self.operation_id();
        if let Some(last) = &self.last_insert
            && self.random.random_ratio(1, IDLE_CALLS)
        {
            return Request::Insert(Box::new(self.idle(last.clone(), operation_id)));
        }
        if let Some(update) = self.compare_and_set(&operation_id) {
            return Request::Update(update);
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

    /// The opening of a session.
    pub(super) fn opening(&self, uid: &str) -> OpenSessionRequest {
        OpenSessionRequest {
            index_name: "arm".into(),
            uid: uid.to_owned(),
            reserve_count: RESERVED_IDS,
            operation_id: self.operation_id(),
        }
    }

    /// The id of the call.
    fn operation_id(&self) -> String {
        format!("{}-{}", self.name, self.calls)
    }

    /// The tag of the call. No other call gives it to the same point.
    fn tag(&self) -> u64 {
        (self.name << 32) | self.calls
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

    /// One of the points that other writers change too, for one call in some.
    fn contested_id(&mut self) -> Option<u64> {
        let contested = self.contested.as_ref()?;
        if !self.random.random_ratio(1, CONTESTED_CALLS) {
            return None;
        }
        contested.ids.choose(&mut self.random).copied()
    }

    /// Sets the tag of a contested point. The server refuses it if the point changed after the writer had read it.
    fn compare_and_set(&mut self, operation_id: &str) -> Option<UpdateRequest> {
        let id = self.contested_id()?;
        let contested = self.contested.as_ref()?;
        Some(UpdateRequest {
            index_name: "arm".into(),
            ids: vec![id],
            tags: vec![self.tag()],
            if_revision: revision(&contested.uid, contested.seen),
            operation_id: operation_id.to_owned(),
            ..Default::default()
        })
    }

    /// The next batch of the session: puts, removals and a tag.
    fn next_batch(&mut self) -> Request {
        let payloads = self.payloads();
        let mut removed = Vec::new();
        if self.random.random_bool(self.load.removals) {
            removed = self.outdated();
        }
        let tagged = self.contested_id().or(self.mine.last().copied());
        let rows = self.states.rows(payloads.len());
        let tag = self.tag();
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
            tags: vec![tag; ids.len()],
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
    pub(super) fn payload(&self, text: &str, bytes: usize) -> Bytes {
        let noise = &self.noise[text.len().min(bytes)..bytes];
        [text.as_bytes(), noise].concat().into()
    }
}
