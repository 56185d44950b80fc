//! Nothing acknowledged is lost: a server that is killed again and again under its writers comes back with every
//! mutation that it acknowledged, once, at the revision that it said.

use std::{collections::BTreeMap, path::Path};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::{sync::watch, task::JoinSet};
use wayfold_proto::v1::{
    CreateIndexRequest, DeleteIndexRequest, InsertRequest, KnnRequest, ListIndexesRequest,
    NeighborQuery, RemoveRequest,
};
use wayfold_tests::{
    Content, Model, Process, ServerProcess, Signal, States, Stubs, ledger::Entry, row_states,
    server,
};

const SPACE: &str = "R3*SO3:0.15";
const WRITERS: u64 = 8;
/// Kills, unless the environment variable `CRASH_KILLS` says otherwise.
const KILLS: u64 = 20;
const SEED: u64 = 3;

/// A client that writes one mutation after another, and remembers the one of which it does not know what became.
struct Writer {
    name: u64,
    random: ChaCha8Rng,
    states: States,
    calls: u64,
    mine: Vec<u64>,
    unknown: Option<Request>,
    ledger: Vec<Entry>,
}

#[derive(Clone)]
enum Request {
    Insert(InsertRequest),
    Remove(RemoveRequest),
}

impl Writer {
    fn new(name: u64) -> Self {
        Self {
            name,
            random: ChaCha8Rng::seed_from_u64(SEED + name),
            states: States::new(SPACE.parse().unwrap(), SEED + name),
            calls: 0,
            mine: Vec::new(),
            unknown: None,
            ledger: Vec::new(),
        }
    }

    fn next(&mut self) -> Request {
        self.calls += 1;
        let operation_id = format!("{}-{}", self.name, self.calls);
        if !self.mine.is_empty() && self.random.random_bool(0.2) {
            let at = self.random.random_range(0..self.mine.len());
            return Request::Remove(RemoveRequest {
                index: "arm".into(),
                ids: vec![self.mine.swap_remove(at)],
                operation_id,
                ..Default::default()
            });
        }
        let rows = self.random.random_range(1..4);
        let payloads = (0..rows).map(|row| format!("{operation_id}/{row}").into());
        Request::Insert(InsertRequest {
            index: "arm".into(),
            states: Some(row_states(&self.states.rows(rows), 7)),
            tags: vec![self.name; rows],
            payloads: payloads.collect(),
            neighbors: Some(NeighborQuery {
                k: Some(3),
                ..Default::default()
            }),
            operation_id,
            ..Default::default()
        })
    }

    /// Writes until the server is gone; first what may or may not have taken place before.
    async fn write(mut self, mut stubs: Stubs, acknowledged: watch::Sender<u64>) -> Self {
        loop {
            let request = match self.unknown.take() {
                Some(request) => request,
                None => self.next(),
            };
            self.unknown = Some(request.clone());
            if !self.send(&mut stubs, request).await {
                return self;
            }
            self.unknown = None;
            acknowledged.send_modify(|count| *count += 1);
        }
    }

    /// Whether it was acknowledged.
    async fn send(&mut self, stubs: &mut Stubs, request: Request) -> bool {
        match request {
            Request::Insert(request) => {
                let Ok(response) = stubs.points.insert(request.clone()).await else {
                    return false;
                };
                let response = response.into_inner();
                self.mine.extend(&response.ids);
                self.ledger.push(Entry::Insert(request, response));
            }
            Request::Remove(request) => {
                let Ok(response) = stubs.points.remove(request.clone()).await else {
                    return false;
                };
                self.ledger
                    .push(Entry::Remove(request, response.into_inner()));
            }
        }
        true
    }
}

/// A client that creates and deletes indices; of the last one it may not know whether it is there.
#[derive(Default)]
struct Builder {
    calls: u64,
    /// How many points the indices hold that it knows of; none where it deleted one.
    known: BTreeMap<String, Option<u64>>,
}

impl Builder {
    async fn build(mut self, mut stubs: Stubs) -> Self {
        loop {
            self.calls += 1;
            let name = format!("scratch-{}", self.calls % 5);
            let there = self.known.remove(&name).flatten().is_some();
            let done = if there {
                let request = DeleteIndexRequest {
                    name: name.clone(),
                    ..Default::default()
                };
                stubs.indexes.delete_index(request).await.is_ok()
            } else {
                let request = CreateIndexRequest {
                    name: name.clone(),
                    space_text: "R2".into(),
                    ..Default::default()
                };
                let created = stubs.indexes.create_index(request).await.is_ok();
                let row = InsertRequest {
                    index: name.clone(),
                    states: Some(row_states(&[1.0, 2.0], 2)),
                    ..Default::default()
                };
                created && stubs.points.insert(row).await.is_ok()
            };
            if !done {
                return self;
            }
            self.known.insert(name, (!there).then_some(1));
        }
    }

    async fn check(&mut self, stubs: &mut Stubs) {
        let request = ListIndexesRequest::default();
        let listed = stubs.indexes.list_indexes(request).await.unwrap();
        let listed = listed.into_inner().indexes;
        let listed = listed.into_iter().filter(|index| index.name != "arm");
        let listed: BTreeMap<_, _> = listed.map(|index| (index.name, index.points)).collect();
        for (name, points) in &self.known {
            assert_eq!(listed.get(name), points.as_ref(), "{name}");
        }
        let listed = listed.into_iter();
        self.known = listed.map(|(name, points)| (name, Some(points))).collect();
    }
}

fn start(data: &Path) -> ServerProcess {
    server!("--data", data.to_str().unwrap())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_is_killed_comes_back_with_all_that_it_acknowledged() {
    println!("seed {SEED}");
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().join("data");
    let mut random = ChaCha8Rng::seed_from_u64(SEED);
    let mut server = start(&data);
    Stubs::connect(server.uri())
        .await
        .create("arm", SPACE)
        .await;
    let mut writers: Vec<Writer> = (0..WRITERS).map(Writer::new).collect();
    let mut builder = Builder::default();
    let mut model = Model::new(SPACE.parse().unwrap());
    let mut probes = States::new(SPACE.parse().unwrap(), SEED + WRITERS);
    let kills = std::env::var("CRASH_KILLS").map_or(KILLS, |kills| kills.parse().unwrap());
    let mut answered = 0;
    for _ in 0..kills {
        let moment = random.random_range(1..150);
        let acknowledged = watch::Sender::new(0);
        let mut killed = acknowledged.subscribe();
        let mut writing = JoinSet::new();
        for writer in writers.drain(..) {
            let stubs = Stubs::connect(server.uri()).await;
            writing.spawn(writer.write(stubs, acknowledged.clone()));
        }
        let building = tokio::spawn(builder.build(Stubs::connect(server.uri()).await));
        killed.wait_for(|&count| count >= moment).await.unwrap();
        server.stop(Signal::Kill);
        writers = writing.join_all().await;
        writers.sort_by_key(|writer| writer.name);
        builder = building.await.unwrap();

        // Sometimes also while it starts, at whatever point it has come to.
        for _ in 0..random.random_range(0..2) {
            let program = env!("CARGO_BIN_EXE_server-process");
            let data = data.to_str().unwrap();
            let starting = Process::start(program, &["--grpc", "127.0.0.1:0", "--data", data]);
            starting.signal(Signal::Kill);
            starting.finish();
        }

        server = start(&data);
        let mut stubs = Stubs::connect(server.uri()).await;
        builder.check(&mut stubs).await;
        // What is unknown becomes known by asking again, and has taken place once.
        for writer in &mut writers {
            if let Some(request) = writer.unknown.take() {
                assert!(writer.send(&mut stubs, request).await);
            }
        }
        let mut entries: Vec<Entry> = writers
            .iter_mut()
            .flat_map(|writer| writer.ledger.drain(..))
            .collect();
        entries.sort_by_key(Entry::revision);
        for entry in &entries {
            model.check(entry);
        }
        answered += entries.len();
        model.check_content(&Content::read(&stubs, "arm").await.unwrap());
        let request = KnnRequest {
            index: "arm".into(),
            states: Some(row_states(&probes.rows(20), 7)),
            k: 10,
            ..Default::default()
        };
        let answer = stubs.points.knn(request.clone()).await.unwrap();
        model.knn(&request, &answer.into_inner());
    }
    // Every call that was answered made a revision of its own, and there is no other.
    assert_eq!(model.revision(), answered as u64);
    println!("{kills} kills, {answered} mutations acknowledged, each of them found once");
}
