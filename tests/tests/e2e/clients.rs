//! Clients that run while a server or its disk fails, and the checks of the answers that they received.

mod builder;
mod reader;
mod tally;
mod writer;

use std::path::PathBuf;

use tokio::{
    net::unix::pipe,
    sync::watch,
    task::{JoinHandle, JoinSet},
};
use tonic::Status;
use wayfold_tests::{
    Content, Model, ServerProcess, Signal, States, Stubs, knn_request, ledger::Entry,
};

use builder::Builder;
use reader::{Reader, ReaderAnswer};
pub(crate) use tally::Tally;
pub(crate) use writer::{Acknowledged, Conflict, Load, Writer};

/// The space of the index that the writers and readers share, `arm`.
pub(crate) const SPACE: &str = "R3*SO3:0.15";
/// Its coordinates.
const COORDINATES: usize = 7;
const READERS: u64 = 2;
/// Readers read without pause; one read in this many is kept.
const READ_SAMPLING: usize = 20;

/// The time at which a server is killed or its disk fails.
#[derive(Clone, Copy, Debug)]
pub(crate) enum FaultTime {
    /// After this many acknowledged mutations.
    Acknowledged(u64),
    /// After this many creations and deletions of indices have begun.
    Built(u64),
}

/// Eight writers, four of them with a session, two readers, one client that creates and deletes indices, and a model of
/// the expected content.
pub(crate) struct Clients {
    writers: Vec<Writer>,
    readers: Vec<Reader>,
    builder: Builder,
    uid: String,
    model: Model,
    tally: Tally,
    probes: States,
    looked: Option<PathBuf>,
}

/// The running clients.
struct RunningClients {
    writing: JoinSet<Writer>,
    reading: JoinSet<Reader>,
    /// The signal that ends the readers; nothing else does.
    over: watch::Sender<bool>,
    building: JoinHandle<Builder>,
    at_acknowledged: watch::Receiver<u64>,
    at_built: watch::Receiver<u64>,
}

impl RunningClients {
    async fn wait_until(&mut self, moment: FaultTime) {
        let reached = match moment {
            FaultTime::Acknowledged(count) => {
                self.at_acknowledged.wait_for(|&now| now >= count).await
            }
            FaultTime::Built(count) => self.at_built.wait_for(|&now| now >= count).await,
        };
        assert!(reached.is_ok(), "the server has ended by itself");
    }
}

impl Clients {
    /// The number of writers.
    pub(crate) const WRITERS: usize = 8;

    /// Creates the index that the clients share.
    pub(crate) async fn new(server: &ServerProcess, seed: u64, load: Load) -> Self {
        let mut stubs = Stubs::connect(server.uri()).await;
        let uid = stubs.create("arm", SPACE).await.revision.unwrap().uid;
        let writers = Self::WRITERS as u64;
        let readers = (0..READERS).map(|reader| Reader::new(seed + writers + reader, &uid));
        let readers = readers.collect();
        let mut clients: Vec<Writer> = (0..writers)
            .map(|name| Writer::new(name, seed, load))
            .collect();
        for writer in clients.iter_mut().skip(1).step_by(2) {
            writer.open_session(&mut stubs, &uid).await;
        }
        Self {
            writers: clients,
            readers,
            builder: Builder::default(),
            uid,
            model: Model::new(SPACE.parse().unwrap()),
            tally: Tally::default(),
            probes: States::new(SPACE.parse().unwrap(), seed + writers + READERS),
            looked: None,
        }
    }

    /// From now on, readers write a byte into this pipe, which the server has open, after each read.
    pub(crate) fn tell_of_looks(&mut self, looked: PathBuf) {
        self.looked = Some(looked);
    }

    /// Runs all clients until the server is killed.
    pub(crate) async fn work(&mut self, server: ServerProcess, moment: FaultTime) {
        let mut working = self.begin(&server).await;
        working.wait_until(moment).await;
        server.stop(Signal::Kill);
        self.end(working).await;
        for reader in &mut self.readers {
            (reader.refusals, reader.searches_refused) = (Vec::new(), 0);
        }
    }

    /// Runs all clients until each writer is refused, which `fail` causes. Returns the refusals.
    pub(crate) async fn work_until_refused(
        &mut self,
        server: &ServerProcess,
        moment: FaultTime,
        fail: impl FnOnce(),
    ) -> Vec<Status> {
        let mut working = self.begin(server).await;
        working.wait_until(moment).await;
        fail();
        self.end(working).await;
        let refusals = self.writers.iter().map(|writer| writer.refusal.clone());
        refusals.map(Option::unwrap).collect()
    }

    /// Lets each writer retry its unknown mutation. Returns the number of retries that are refused.
    pub(crate) async fn ask_again(&mut self, server: &ServerProcess) -> usize {
        let mut stubs = Stubs::connect(server.uri()).await;
        let mut refused = 0;
        for writer in &mut self.writers {
            refused += usize::from(!writer.ask_again(&mut stubs).await);
        }
        refused
    }

    /// Lets each reader read `times` times.
    pub(crate) async fn look(&mut self, server: &ServerProcess, times: usize) {
        let stubs = Stubs::connect(server.uri()).await;
        for reader in &mut self.readers {
            for _ in 0..times {
                reader.note(stubs.clone()).await;
            }
        }
    }

    /// Lets the readers read until `wait` ends.
    pub(crate) async fn look_during(
        &mut self,
        server: &mut ServerProcess,
        wait: impl FnOnce(&mut ServerProcess),
    ) {
        let over = watch::Sender::new(false);
        let mut reading = JoinSet::new();
        for reader in self.readers.drain(..) {
            let stubs = Stubs::connect(server.uri()).await;
            let seen = reader.seen.len();
            let reading_on = reader.read(stubs, over.subscribe(), None);
            reading.spawn(async move { (seen, reading_on.await) });
        }
        tokio::task::block_in_place(|| wait(server));
        over.send_replace(true);
        for (seen, mut reader) in reading.join_all().await {
            // Comparing all answers with brute force would take longer than reading them.
            let mut at = 0;
            reader.seen.retain(|_| {
                at += 1;
                at <= seen || at % READ_SAMPLING == 0
            });
            self.readers.push(reader);
        }
    }

    /// The refusals of reads; none of them is a search.
    pub(crate) fn refused_reads(&mut self) -> Vec<Status> {
        let mut refusals = Vec::new();
        for reader in &mut self.readers {
            assert_eq!(reader.searches_refused, 0, "{:?}", reader.refusals);
            refusals.append(&mut reader.refusals);
        }
        refusals
    }

    /// Starts all clients.
    async fn begin(&mut self, server: &ServerProcess) -> RunningClients {
        let (acknowledged, built) = (watch::Sender::new(0), watch::Sender::new(0));
        let (at_acknowledged, at_built) = (acknowledged.subscribe(), built.subscribe());
        let (mut writing, mut reading) = (JoinSet::new(), JoinSet::new());
        let over = watch::Sender::new(false);
        for writer in self.writers.drain(..) {
            let stubs = Stubs::connect(server.uri()).await;
            writing.spawn(writer.write(stubs, acknowledged.clone(), usize::MAX));
        }
        for reader in self.readers.drain(..) {
            let stubs = Stubs::connect(server.uri()).await;
            let looked = self.looked.as_ref();
            let looked = looked.map(|pipe| pipe::OpenOptions::new().open_sender(pipe).unwrap());
            reading.spawn(reader.read(stubs, over.subscribe(), looked));
        }
        let builder = std::mem::take(&mut self.builder);
        let building = tokio::spawn(builder.build(Stubs::connect(server.uri()).await, built));
        // Only running clients hold the senders, so the end of a server that stopped by itself is noticed.
        RunningClients {
            writing,
            reading,
            over,
            building,
            at_acknowledged,
            at_built,
        }
    }

    /// Each writer ends after its refusal.
    async fn end(&mut self, working: RunningClients) {
        self.writers = working.writing.join_all().await;
        self.writers.sort_by_key(|writer| writer.name);
        working.over.send_replace(true);
        self.readers = working.reading.join_all().await;
        self.builder = working.building.await.unwrap();
    }

    /// Checks that each acknowledged mutation is stored once and in order, that each read answer still holds, and that
    /// answers equal brute force.
    pub(crate) async fn check(&mut self, server: &ServerProcess) {
        let mut stubs = Stubs::connect(server.uri()).await;
        let described = stubs.describe("arm").await;
        assert_eq!(described.revision.unwrap().uid, self.uid);
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
        let mut seen: Vec<ReaderAnswer> = Vec::new();
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
        let request = knn_request("arm", &self.probes.rows(20), COORDINATES, 10);
        let answer = stubs.points.knn(request.clone()).await.unwrap();
        self.model.knn(&request, &answer.into_inner());
        // Each acknowledged call that changed something made its own revision, and there are no other revisions.
        assert_eq!(self.model.revision(), self.tally.effective);
    }

    /// Compares the acknowledged mutations with the newest content and counts the lost ones. Returns the content.
    pub(crate) async fn count(&mut self, server: &ServerProcess) -> Content {
        self.acknowledged();
        let stubs = Stubs::connect(server.uri()).await;
        let content = Content::read(&stubs, "arm").await.unwrap();
        self.tally.count(&content);
        content
    }

    /// The count so far.
    pub(crate) fn tally(&self) -> &Tally {
        &self.tally
    }

    /// The uid of the index they share, as it was created.
    pub(crate) fn uid(&self) -> &str {
        &self.uid
    }

    /// The mutations acknowledged since the last call, in the order of revisions.
    fn acknowledged(&mut self) -> Vec<Entry> {
        let ledgers = self.writers.iter_mut().map(|writer| &mut writer.ledger);
        let drained = ledgers.flat_map(|ledger| ledger.drain(..));
        let mut entries: Vec<Entry> = drained.map(|it| it.entry).collect();
        entries.sort_by_key(|entry| (entry.revision(), !entry.changed()));
        for entry in &entries {
            self.tally.note(entry);
        }
        entries
    }

    /// Checks the readers' answers of the model's revision.
    fn check_seen(&self, seen: &mut std::iter::Peekable<std::vec::IntoIter<ReaderAnswer>>) {
        let here = (self.uid.as_str(), self.model.revision());
        while let Some(seen) = seen.next_if(|seen| seen.at() == here) {
            seen.check(&self.model);
        }
    }
}
