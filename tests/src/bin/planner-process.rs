//! One of the planners that share an index: `planner-process URI INDEX SEED ROUNDS LEDGER`.
//!
//! It prints `ready`, waits for a line, and then inserts, removes and searches in an order drawn from its seed. It
//! writes the answers to the ledger.

use std::{
    env,
    io::{self, BufRead},
    path::Path,
};

use rand::RngExt;
use wayfold_proto::v1::{
    Filter, InsertRequest, KnnRequest, NeighborSpec, OnConflict, QueryRequest, RemoveRequest,
    Revision, knn_request, neighbor_spec, query_request,
};
use wayfold_tests::{States, Stubs, ledger, ledger::Entry, number, row_states};

#[tokio::main(flavor = "current_thread")]
async fn main() {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let [uri, index, seed, rounds, path] = arguments.as_slice() else {
        panic!("usage: planner-process URI INDEX SEED ROUNDS LEDGER");
    };
    let seed = seed.parse().expect("a seed");
    let rounds: usize = rounds.parse().expect("a number of rounds");
    let mut stubs = Stubs::connect(uri).await;
    let description = stubs.describe(index).await;
    let space = description.space_text.parse().expect("a space");
    let mut planner = Planner {
        stubs,
        states: States::new(space, seed),
        index: index.clone(),
        uid: description.revision.expect("a revision").uid,
        revision: 0,
        first_id: (seed + 1) << 32,
        given_ids: 0,
        own: Vec::new(),
    };

    println!("ready");
    let mut line = String::new();
    io::stdin().lock().read_line(&mut line).expect("a line");
    let mut entries = Vec::with_capacity(rounds);
    for _ in 0..rounds {
        let entry = planner.act().await;
        planner.revision = planner.revision.max(entry.revision());
        entries.push(entry);
    }
    ledger::write(Path::new(path), &entries);
}

struct Planner {
    stubs: Stubs,
    states: States,
    index: String,
    uid: String,
    /// The newest revision in an answer.
    revision: u64,
    first_id: u64,
    given_ids: u64,
    /// The points it stored and has not removed.
    own: Vec<u64>,
}

impl Planner {
    async fn act(&mut self) -> Entry {
        match self.states.rng().random_range(0..10) {
            0..5 => self.insert().await,
            5 => self.remove().await,
            6 if !self.own.is_empty() => self.replace().await,
            6..9 => self.knn().await,
            _ => self.query().await,
        }
    }

    /// Inserts under assigned ids or its own ones, and requests the neighbours to which an edge is tried.
    async fn insert(&mut self) -> Entry {
        let rows = self.up_to(16);
        let rng = self.states.rng();
        let assigned = rng.random_bool(0.5);
        let tags = (0..rows).map(|_| rng.random_range(0..4)).collect();
        let since_revision = if rng.random_bool(0.3) {
            self.revision
        } else {
            0
        };
        let neighbor_spec = NeighborSpec {
            k_form: Some(neighbor_spec::KForm::K(rng.random_range(1..=12))),
            radius_form: rng
                .random_bool(0.5)
                .then_some(neighbor_spec::RadiusForm::Radius(3.0)),
            filter: Some(Filter {
                since_revision: Some(self.revision_at(since_revision)),
                ..Default::default()
            }),
            ..Default::default()
        };
        let rng = self.states.rng();
        let min_separation = if rng.random_bool(0.3) { 0.9 } else { 0.0 };
        let ids = match assigned {
            true => Vec::new(),
            false => self.new_ids(rows),
        };
        let request = InsertRequest {
            ids,
            tags,
            neighbor_spec: Some(neighbor_spec),
            min_separation,
            ..self.insert_of(rows)
        };
        self.inserted(request).await
    }

    /// A point moves.
    async fn replace(&mut self) -> Entry {
        let at = self.up_to(self.own.len()) - 1;
        let request = InsertRequest {
            ids: vec![self.own.swap_remove(at)],
            payloads: vec!["moved".into()],
            on_conflict: OnConflict::Replace.into(),
            ..self.insert_of(1)
        };
        self.inserted(request).await
    }

    async fn inserted(&mut self, request: InsertRequest) -> Entry {
        let response = self.stubs.insert(request.clone()).await;
        let entry = Entry::Insert(request, response);
        if let Entry::Insert(_, response) = &entry {
            let stored = response.outcomes().zip(&response.ids);
            let stored = stored.filter(|(outcome, _)| {
                use wayfold_proto::v1::Outcome::{Inserted, Replaced};
                matches!(outcome, Inserted | Replaced)
            });
            self.own.extend(stored.map(|(_, &id)| id));
        }
        entry
    }

    /// Removes some of its own points, and one that never existed.
    async fn remove(&mut self) -> Entry {
        let count = self.up_to(4).min(self.own.len());
        let mut ids = self.own.split_off(self.own.len() - count);
        ids.push(0);
        let request = RemoveRequest {
            index_name: self.index.clone(),
            ids,
            ..Default::default()
        };
        let response = self.stubs.points.remove(request.clone()).await;
        Entry::Remove(request, response.expect("a removal").into_inner())
    }

    async fn knn(&mut self) -> Entry {
        let rows = self.up_to(4);
        let request = KnnRequest {
            index_name: self.index.clone(),
            states: Some(self.rows(rows)),
            k_form: Some(knn_request::KForm::K(
                self.states.rng().random_range(1..=20),
            )),
            radius_form: (self.states.rng().random_bool(0.3))
                .then_some(knn_request::RadiusForm::Radius(2.0)),
            filter: self.filter(),
            min_revision: self.min_revision(),
            ..Default::default()
        };
        let response = self.stubs.points.knn(request.clone()).await;
        let response = response.expect("neighbours").into_inner();
        check_revision(&request.min_revision, &response.revision);
        Entry::Knn(request, response)
    }

    async fn query(&mut self) -> Entry {
        let rows = self.up_to(4);
        let request = QueryRequest {
            index_name: self.index.clone(),
            states: Some(self.rows(rows)),
            radius_form: Some(query_request::RadiusForm::Radius(
                self.states.rng().random_range(0.0..3.0),
            )),
            filter: self.filter(),
            min_revision: self.min_revision(),
            ..Default::default()
        };
        let response = self.stubs.points.query(request.clone()).await;
        let response = response.expect("neighbours").into_inner();
        check_revision(&request.min_revision, &response.revision);
        Entry::Query(request, response)
    }

    fn insert_of(&mut self, rows: usize) -> InsertRequest {
        InsertRequest {
            index_name: self.index.clone(),
            states: Some(self.rows(rows)),
            uid: self.uid.clone(),
            ..Default::default()
        }
    }

    fn rows(&mut self, rows: usize) -> wayfold_proto::v1::States {
        let coordinates = self.states.space().coordinates();
        row_states(&self.states.rows(rows), coordinates)
    }

    fn filter(&mut self) -> Option<Filter> {
        let since = self.revision / 2;
        let rng = self.states.rng();
        if !rng.random_bool(0.4) {
            return None;
        }
        let tag_value = rng.random_range(0..2);
        let since = if rng.random_bool(0.5) { since } else { 0 };
        Some(Filter {
            tag_mask: 1,
            tag_value,
            since_revision: Some(self.revision_at(since)),
        })
    }

    /// Half of its reads must see its own writes.
    fn min_revision(&mut self) -> Option<Revision> {
        let own_writes = self.states.rng().random_bool(0.5);
        Some(self.revision_at(if own_writes { self.revision } else { 0 }))
    }

    fn revision_at(&self, number: u64) -> Revision {
        Revision {
            uid: self.uid.clone(),
            number,
        }
    }

    fn new_ids(&mut self, count: usize) -> Vec<u64> {
        let next = self.first_id + self.given_ids;
        self.given_ids += count as u64;
        (next..next + count as u64).collect()
    }

    fn up_to(&mut self, most: usize) -> usize {
        self.states.rng().random_range(1..=most)
    }
}

fn check_revision(min: &Option<Revision>, revision: &Option<Revision>) {
    let (min, revision) = (number(min), number(revision));
    assert!(revision >= min, "revision {revision} before {min}");
}
