//! A client that writes and keeps a ledger of the acknowledged mutations.

use prost::bytes::Bytes;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::sync::watch;
use tonic::Status;
use wayfold_proto::v1::{InsertRequest, RemoveRequest};
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
    unknown: Option<Request>,
    /// The refusal of that mutation, if it was refused.
    pub(crate) refusal: Option<Status>,
    /// The acknowledged mutations since they were last taken.
    pub(crate) ledger: Vec<Entry>,
}

#[derive(Clone)]
enum Request {
    Insert(Box<InsertRequest>),
    Remove(RemoveRequest),
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
            unknown: None,
            refusal: None,
            ledger: Vec::new(),
        }
    }

    fn next(&mut self) -> Request {
        self.calls += 1;
        let operation_id = format!("{}-{}", self.name, self.calls);
        if self.random.random_bool(self.load.removals) {
            let ids = self.outdated();
            if !ids.is_empty() {
                return Request::Remove(RemoveRequest {
                    index_name: "arm".into(),
                    ids,
                    operation_id,
                    ..Default::default()
                });
            }
        }
        let heavy = self.random.random_bool(self.load.heavy);
        let (rows, bytes) = if heavy {
            (4, HEAVY_BYTES)
        } else {
            (self.random.random_range(1..=self.load.rows), 0)
        };
        let payloads = (0..rows).map(|row| self.payload(&format!("{operation_id}/{row}"), bytes));
        let payloads = payloads.collect();
        Request::Insert(Box::new(InsertRequest {
            index_name: "arm".into(),
            states: Some(row_states(&self.states.rows(rows), COORDINATES)),
            tags: vec![self.name; rows],
            payloads,
            neighbors: heavy.then(|| k_nearest(3)),
            operation_id,
            ..Default::default()
        }))
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

    /// Writes until a refusal or the end of the server, beginning with the mutation with the unknown outcome.
    pub(crate) async fn write(
        mut self,
        mut stubs: Stubs,
        acknowledged: watch::Sender<u64>,
    ) -> Self {
        loop {
            let request = match self.unknown.take() {
                Some(request) => request,
                None => self.next(),
            };
            if !self.send(&mut stubs, request).await {
                return self;
            }
            acknowledged.send_modify(|count| *count += 1);
        }
    }

    /// Resolves the unknown mutation by retries; it takes effect once.
    pub(crate) async fn resolve(&mut self, stubs: &mut Stubs) {
        let known = self.ask_again(stubs).await;
        assert!(known, "{:?}", self.refusal);
    }

    /// Retries the unknown mutation; false if its outcome is still unknown.
    pub(crate) async fn ask_again(&mut self, stubs: &mut Stubs) -> bool {
        match self.unknown.take() {
            Some(request) => self.send(stubs, request).await,
            None => true,
        }
    }

    /// Returns true if the mutation was acknowledged; otherwise its outcome is unknown.
    async fn send(&mut self, stubs: &mut Stubs, request: Request) -> bool {
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
        };
        let entry = match answered {
            Ok(entry) => entry,
            Err(status) => {
                self.unknown = Some(request);
                self.refusal = Some(status);
                return false;
            }
        };
        self.refusal = None;
        if let Entry::Insert(insert, response) = &entry {
            let heavy = insert.payloads[0].len() == HEAVY_BYTES;
            let ids = if heavy {
                &mut self.heavy
            } else {
                &mut self.mine
            };
            ids.extend(&response.ids);
        }
        self.ledger.push(entry);
        true
    }
}
