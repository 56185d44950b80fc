//! A client of an index that clients create, fill and delete, again and again under one name.

use std::{collections::HashMap, time::Instant};

use prost::bytes::Bytes;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tonic::{Code, Status};
use wayfold_proto::v1::{
    CreateIndexRequest, DeleteIndexRequest, InsertRequest, InsertResponse, ScanRequest,
    create_index_request::SpaceForm,
};
use wayfold_tests::{
    Content, INCLUDE_ALL, Refusal, Stubs,
    history::{
        digest,
        names::{NameCall, NameOperation},
    },
    ledger::Entry,
    revision, row_states,
};

use super::{
    client::{Scene, connect, is_data_loss},
    history::{History, scan},
};
use crate::clients::Acknowledged;

/// The name of the index.
pub(super) const NAME: &str = "side";
const SPACE: &str = "R2";
/// A maker makes a call each time that the writers have made this many.
const WRITES_A_CALL: u64 = 5;

/// The relative frequencies of the calls for a known index.
const DELETIONS: u32 = 1;
const CREATIONS: u32 = 1;
const READS: u32 = 3;
const INSERTS: u32 = 5;

/// See the module.
pub(super) struct Maker {
    client: u64,
    /// Its calls.
    pub(super) operations: Vec<NameOperation>,
    /// The refusals that say that NATS has lost something.
    pub(super) data_losses: u64,
    history: History,
    random: ChaCha8Rng,
    calls: u64,
    /// The uid of the index that it takes for the present one.
    known: Option<String>,
    /// The newest revision of each index that it knows, by its uid.
    newest: HashMap<String, u64>,
    /// The insert of unknown outcome, and the time before its first attempt.
    unknown: Option<(InsertRequest, Instant)>,
    /// The server that it asks.
    server: u64,
}

impl Maker {
    /// A client with this number; equal numbers and seeds make the same choices.
    pub(super) fn new(client: u64, seed: u64, history: History) -> Self {
        Self {
            client,
            operations: Vec::new(),
            data_losses: 0,
            history,
            random: ChaCha8Rng::seed_from_u64(seed + client),
            calls: 0,
            known: None,
            newest: HashMap::new(),
            unknown: None,
            server: 0,
        }
    }

    /// Makes calls until it is over, each at another server.
    pub(super) async fn work(mut self, scene: Scene) -> Self {
        let mut over = scene.over.clone();
        let mut acknowledged = scene.acknowledged.subscribe();
        while !*over.borrow() {
            let target = *acknowledged.borrow() + WRITES_A_CALL;
            let written = async { acknowledged.wait_for(|now| *now >= target).await.is_ok() };
            tokio::select! {
                _ = over.changed() => {}
                _ = written => {
                    let uri = scene.choose_server(&mut self.random);
                    if let Ok(mut stubs) = connect(&uri).await {
                        let _calling = scene.calling.read().await;
                        self.server = digest(&uri);
                        self.call(&mut stubs).await;
                    }
                }
            }
        }
        if let Some((insert, invoked)) = self.unknown.take() {
            self.note_unknown(insert, invoked);
        }
        self
    }

    async fn call(&mut self, stubs: &mut Stubs) {
        self.calls += 1;
        if let Some((insert, invoked)) = self.unknown.take() {
            return self.insert(stubs, insert, invoked).await;
        }
        let Some(uid) = self.known.clone() else {
            return self.create(stubs).await;
        };
        let kind = self
            .random
            .random_range(0..DELETIONS + CREATIONS + READS + INSERTS);
        if kind < DELETIONS {
            self.delete(stubs, uid).await;
        } else if kind < DELETIONS + CREATIONS {
            self.create(stubs).await;
        } else if kind < DELETIONS + CREATIONS + READS {
            self.read(stubs, uid).await;
        } else {
            let insert = self.next_insert(uid);
            self.insert(stubs, insert, Instant::now()).await;
        }
    }

    async fn create(&mut self, stubs: &mut Stubs) {
        let request = CreateIndexRequest {
            name: NAME.into(),
            space_form: Some(SpaceForm::SpaceText(SPACE.into())),
            ..Default::default()
        };
        let invoked = Instant::now();
        match stubs.indexes.create_index(request).await {
            Ok(response) => {
                let response = response.into_inner();
                let index = response.index.expect("a description");
                let uid = index.revision.expect("a revision").uid;
                self.known = Some(uid.clone());
                let created = response.created;
                self.note(invoked, NameCall::Create { uid, created });
            }
            // Another client has deleted the index that had the name.
            Err(refusal) if refusal.code() == Code::NotFound => {}
            Err(refusal) => self.check_refusal(&refusal),
        }
    }

    async fn delete(&mut self, stubs: &mut Stubs, uid: String) {
        let request = DeleteIndexRequest {
            index_name: NAME.into(),
            uid: uid.clone(),
        };
        let invoked = Instant::now();
        match stubs.indexes.delete_index(request).await {
            Ok(response) => {
                assert_eq!(response.into_inner().uid, uid);
                self.known = None;
                self.note(invoked, NameCall::Delete(uid));
            }
            Err(refusal) if is_gone(&refusal) => self.note_gone(invoked, uid),
            Err(refusal) => {
                self.check_refusal(&refusal);
                let unknown = NameCall::Delete(uid);
                self.note_at(invoked, None, unknown);
            }
        }
    }

    async fn read(&mut self, stubs: &mut Stubs, uid: String) {
        let newest = self.newest.get(&uid).copied().unwrap_or_default();
        let latest = self.random.random_bool(0.5);
        let request = ScanRequest {
            index_name: NAME.into(),
            include: Some(INCLUDE_ALL),
            min_revision: revision(&uid, newest),
            latest,
            ..Default::default()
        };
        let invoked = Instant::now();
        match Content::read_as(stubs, request).await {
            Ok(content) => {
                assert_eq!(content.uid, uid);
                self.has_seen(&uid, content.revision);
                self.note(invoked, NameCall::Points(uid, scan(latest, &content)));
            }
            Err(refusal) if is_gone(&refusal) => self.note_gone(invoked, uid),
            Err(refusal) => self.check_refusal(&refusal),
        }
    }

    /// The insert of a point with a payload of its own.
    fn next_insert(&mut self, uid: String) -> InsertRequest {
        let name = format!("{}-{}", self.client, self.calls);
        let row: [f64; 2] = self.random.random();
        InsertRequest {
            index_name: NAME.into(),
            states: Some(row_states(&row, row.len())),
            tags: vec![self.client],
            payloads: vec![Bytes::from(name.clone())],
            operation_id: name,
            uid,
            ..Default::default()
        }
    }

    async fn insert(&mut self, stubs: &mut Stubs, insert: InsertRequest, invoked: Instant) {
        match stubs.points.insert(insert.clone()).await {
            Ok(response) => {
                let (uid, response) = (insert.uid.clone(), response.into_inner());
                let acknowledged = Acknowledged {
                    entry: Entry::Insert(insert, response),
                    invoked,
                    returned: Instant::now(),
                };
                self.has_seen(&uid, acknowledged.entry.revision());
                let operation = self.history.mutation(self.client, &acknowledged);
                let call = NameCall::Points(uid, operation.call);
                self.note_at(invoked, Some(acknowledged.returned), call);
            }
            Err(refusal) if is_gone(&refusal) => {
                self.note_gone(invoked, insert.uid.clone());
                // An attempt before may have taken effect.
                self.note_unknown(insert, invoked);
            }
            Err(refusal) => {
                self.check_refusal(&refusal);
                self.unknown = Some((insert, invoked));
            }
        }
    }

    fn has_seen(&mut self, uid: &str, revision: u64) {
        let newest = self.newest.entry(uid.to_owned()).or_default();
        *newest = revision.max(*newest);
    }

    fn note(&mut self, invoked: Instant, call: NameCall) {
        self.note_at(invoked, Some(Instant::now()), call);
    }

    fn note_at(&mut self, invoked: Instant, returned: Option<Instant>, call: NameCall) {
        let from = (self.client, self.server);
        let operation = self.history.named(from, invoked, returned, call);
        self.operations.push(operation);
    }

    /// The index is gone.
    fn note_gone(&mut self, invoked: Instant, uid: String) {
        self.known = self.known.take().filter(|known| *known != uid);
        self.note(invoked, NameCall::Gone(uid));
    }

    /// An insert has no outcome.
    fn note_unknown(&mut self, insert: InsertRequest, invoked: Instant) {
        let uid = insert.uid.clone();
        let entry = Entry::Insert(insert, InsertResponse::default());
        let operation = self.history.unknown(self.client, &entry, invoked);
        self.note_at(invoked, None, NameCall::Points(uid, operation.call));
    }

    fn check_refusal(&mut self, refusal: &Status) {
        self.data_losses += u64::from(is_data_loss(refusal));
    }
}

/// True if the index with the uid of the call was deleted.
fn is_gone(refusal: &Status) -> bool {
    let is_refused = matches!(refusal.code(), Code::NotFound | Code::FailedPrecondition);
    is_refused
        && matches!(
            &*Refusal::of(refusal).reason,
            "INDEX_NOT_FOUND" | "UID_MISMATCH"
        )
}
