//! The clients that are at work while a server goes down, and what they know afterwards.

mod builder;
mod reader;
mod tally;
mod writer;

use tokio::{sync::watch, task::JoinSet};
use wayfold_proto::v1::KnnRequest;
use wayfold_tests::{
    Content, Model, ServerProcess, Signal, States, Stubs, ledger::Entry, row_states,
};

use builder::Builder;
use reader::{Reader, Seen};
pub(crate) use tally::Tally;
pub(crate) use writer::Load;
use writer::Writer;

/// The space of the index that the writers and readers share, `arm`.
const SPACE: &str = "R3*SO3:0.15";
/// Its coordinates.
const COORDINATES: usize = 7;
const WRITERS: u64 = 8;
const READERS: u64 = 2;

/// When a server is killed.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Moment {
    /// Once so many mutations were acknowledged.
    Acknowledged(u64),
    /// Once so many indices were begun to be created or deleted.
    Built(u64),
}

/// Eight writers, two readers, and one who creates and deletes indices; and a model of what they must find.
pub(crate) struct Clients {
    writers: Vec<Writer>,
    readers: Vec<Reader>,
    builder: Builder,
    uid: String,
    model: Model,
    tally: Tally,
    probes: States,
}

impl Clients {
    /// Creates the index they share.
    pub(crate) async fn new(server: &ServerProcess, seed: u64, load: Load) -> Self {
        let mut stubs = Stubs::connect(server.uri()).await;
        let uid = stubs.create("arm", SPACE).await.uid;
        let readers = (0..READERS).map(|reader| Reader::new(seed + WRITERS + reader, &uid));
        let readers = readers.collect();
        Self {
            writers: (0..WRITERS)
                .map(|name| Writer::new(name, seed, load))
                .collect(),
            readers,
            builder: Builder::default(),
            uid,
            model: Model::new(SPACE.parse().unwrap()),
            tally: Tally::default(),
            probes: States::new(SPACE.parse().unwrap(), seed + WRITERS + READERS),
        }
    }

    /// All work, until the server is killed under them.
    pub(crate) async fn work(&mut self, server: ServerProcess, moment: Moment) {
        let (acknowledged, built) = (watch::Sender::new(0), watch::Sender::new(0));
        let (mut at_acknowledged, mut at_built) = (acknowledged.subscribe(), built.subscribe());
        let (mut writing, mut reading) = (JoinSet::new(), JoinSet::new());
        for writer in self.writers.drain(..) {
            let stubs = Stubs::connect(server.uri()).await;
            writing.spawn(writer.write(stubs, acknowledged.clone()));
        }
        for reader in self.readers.drain(..) {
            let stubs = Stubs::connect(server.uri()).await;
            reading.spawn(reader.read(stubs));
        }
        let builder = std::mem::take(&mut self.builder);
        let building = tokio::spawn(builder.build(Stubs::connect(server.uri()).await, built));
        // Only those who work hold it: a server that has ended by itself is noticed.
        drop(acknowledged);
        let reached = match moment {
            Moment::Acknowledged(count) => at_acknowledged.wait_for(|&now| now >= count).await,
            Moment::Built(count) => at_built.wait_for(|&now| now >= count).await,
        };
        assert!(reached.is_ok(), "the server has ended by itself");
        drop(reached);
        server.stop(Signal::Kill);
        self.writers = writing.join_all().await;
        self.writers.sort_by_key(|writer| writer.name);
        self.readers = reading.join_all().await;
        self.builder = building.await.unwrap();
    }

    /// All that was acknowledged is there, once, in order; what was seen is so still; answers equal brute force.
    pub(crate) async fn check(&mut self, server: &ServerProcess) {
        let mut stubs = Stubs::connect(server.uri()).await;
        assert_eq!(stubs.describe("arm").await.uid, self.uid);
        self.builder.check(&mut stubs).await;
        for writer in &mut self.writers {
            writer.resolve(&mut stubs).await;
        }
        let entries = self.acknowledged();
        let content = Content::read(&stubs, "arm").await.unwrap();
        self.tally.count(&content);
        if self.tally.lost + self.tally.duplicated > 0 {
            println!("{}", self.tally);
            assert_eq!((self.tally.lost, self.tally.duplicated), (0, 0));
        }
        let mut seen: Vec<Seen> = Vec::new();
        for reader in &mut self.readers {
            seen.append(&mut reader.seen);
        }
        self.tally.read += seen.len() as u64;
        seen.sort_by_key(|seen| seen.at().1);
        let mut seen = seen.into_iter().peekable();
        for entry in &entries {
            self.check_seen(&mut seen);
            self.model.check(entry);
        }
        self.check_seen(&mut seen);
        if let Some(seen) = seen.next() {
            let newest = self.model.revision();
            panic!("a reader saw {:?}, the newest is {newest}", seen.at());
        }
        self.model.check_content(&content);
        let request = KnnRequest {
            index: "arm".into(),
            states: Some(row_states(&self.probes.rows(20), COORDINATES)),
            k: 10,
            ..Default::default()
        };
        let answer = stubs.points.knn(request.clone()).await.unwrap();
        self.model.knn(&request, &answer.into_inner());
        // Every call that was acknowledged made a revision of its own, and there is no other.
        assert_eq!(self.model.revision(), self.tally.acknowledged);
    }

    /// Compares what was acknowledged with what is left of it, where some may be missing: the newest content.
    pub(crate) async fn count(&mut self, server: &ServerProcess) -> Content {
        self.acknowledged();
        let stubs = Stubs::connect(server.uri()).await;
        let content = Content::read(&stubs, "arm").await.unwrap();
        self.tally.count(&content);
        content
    }

    /// The count until now.
    pub(crate) fn tally(&self) -> &Tally {
        &self.tally
    }

    /// The uid of the index they share, as it was created.
    pub(crate) fn uid(&self) -> &str {
        &self.uid
    }

    /// What was acknowledged since the last time, in the order of revisions.
    fn acknowledged(&mut self) -> Vec<Entry> {
        let ledgers = self.writers.iter_mut().map(|writer| &mut writer.ledger);
        let mut entries: Vec<Entry> = ledgers.flat_map(|ledger| ledger.drain(..)).collect();
        entries.sort_by_key(Entry::revision);
        for entry in &entries {
            self.tally.note(entry);
        }
        entries
    }

    /// Checks what was seen at the model's revision.
    fn check_seen(&self, seen: &mut std::iter::Peekable<std::vec::IntoIter<Seen>>) {
        let here = (self.uid.as_str(), self.model.revision());
        while let Some(seen) = seen.next_if(|seen| seen.at() == here) {
            seen.check(&self.model);
        }
    }
}
