//! A client that writes and reads at one server after the other.

use std::{
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use rand::{Rng, RngExt, SeedableRng, seq::IndexedRandom};
use rand_chacha::ChaCha8Rng;
use tokio::sync::{RwLock, watch};
use tonic::{Code, Status, transport::Endpoint};
use wayfold_proto::v1::{GetRequest, ScanRequest};
use wayfold_tests::{Content, INCLUDE_ALL, Refusal, Stubs, history::Operation, number, revision};

use super::history::{History, points, scan};
use crate::clients::Writer;

/// A client moves to another server after this many mutations and as many looks.
const TURNS_A_SERVER: usize = 4;
/// The mutations before a look.
const CALLS_A_TURN: usize = 3;
/// The points of a read of some.
const POINTS_A_GET: usize = 5;
/// One read in this many is of all points.
const SCANS: u32 = 20;
/// The silence of a server after which a client probes it, and after which it leaves.
const MAX_SILENCE: Duration = Duration::from_secs(1);

/// The state that all clients share.
#[derive(Clone)]
pub(super) struct Scene {
    pub(super) uid: String,
    pub(super) uris: Arc<Mutex<Vec<String>>>,
    pub(super) history: History,
    pub(super) acknowledged: watch::Sender<u64>,
    pub(super) over: watch::Receiver<bool>,
    /// Clients hold it shared while they call. Nobody calls while the run holds it.
    pub(super) calling: Arc<RwLock<()>>,
}

impl Scene {
    /// The address of one of the servers.
    pub(super) fn choose_server(&self, random: &mut impl Rng) -> String {
        let uris = self.uris.lock().unwrap();
        uris.choose(random).unwrap().clone()
    }
}

/// A writer that reads too.
pub(super) struct Client {
    pub(super) writer: Writer,
    /// Its reads.
    pub(super) reads: Vec<Operation>,
    /// The refusals that say that NATS has lost something.
    pub(super) data_losses: u64,
    random: ChaCha8Rng,
    /// The newest revision that it knows.
    newest: u64,
}

impl Client {
    pub(super) fn new(writer: Writer) -> Self {
        Self {
            random: ChaCha8Rng::seed_from_u64(writer.name),
            newest: writer.seen(),
            writer,
            reads: Vec::new(),
            data_losses: 0,
        }
    }

    /// Writes and reads until it is over.
    pub(super) async fn work(mut self, scene: Scene) -> Self {
        while !*scene.over.borrow() {
            let uri = scene.choose_server(&mut self.random);
            let Ok(stubs) = connect(&uri).await else {
                tokio::task::yield_now().await;
                continue;
            };
            for _ in 0..TURNS_A_SERVER {
                let _calling = scene.calling.read().await;
                // It has just come from another server, and must not go backwards.
                if !self.look(&stubs, &scene).await {
                    break;
                }
                self.writer.has_seen(self.newest);
                let acknowledged = scene.acknowledged.clone();
                let writing = self.writer.write(stubs.clone(), acknowledged, CALLS_A_TURN);
                self.writer = writing.await;
                if let Some(refusal) = self.writer.refusal.clone() {
                    self.check_refusal(&refusal);
                    break;
                }
            }
        }
        self
    }

    /// Reads all points or some, those among them that all writers change, the latest or what the server has; false if it is
    /// refused.
    async fn look(&mut self, stubs: &Stubs, scene: &Scene) -> bool {
        let newest = self.writer.ledger.last().map(|it| it.entry.revision());
        self.newest = self.newest.max(newest.unwrap_or_default());
        let (latest, scans) = (
            self.random.random_bool(0.5),
            self.random.random_ratio(1, SCANS),
        );
        let min_revision = revision(&scene.uid, self.newest).filter(|it| it.number > 0);
        let invoked = Instant::now();
        let seen = if scans {
            let request = ScanRequest {
                index_name: "arm".into(),
                include: Some(INCLUDE_ALL),
                min_revision,
                latest,
                ..Default::default()
            };
            let content = Content::read_as(stubs, request).await;
            content.map(|content| (content.revision, scan(latest, &content)))
        } else {
            let mine = self.writer.stored_ids();
            let mine = mine.sample(&mut self.random, POINTS_A_GET);
            let ids = mine.chain(self.writer.contested_ids()).copied().collect();
            let request = GetRequest {
                index_name: "arm".into(),
                ids,
                include: Some(INCLUDE_ALL),
                min_revision,
                latest,
            };
            let answer = stubs.points.clone().get(request).await;
            let answer = answer.map(tonic::Response::into_inner);
            answer.map(|answer| (number(&answer.revision), points(latest, &answer)))
        };
        match seen {
            Ok((revision, call)) => {
                self.newest = self.newest.max(revision);
                let (client, returned) = (self.writer.name, Instant::now());
                let read = scene.history.operation(client, invoked, returned, call);
                self.reads.push(read);
                true
            }
            Err(refusal) => {
                self.check_refusal(&refusal);
                false
            }
        }
    }

    fn check_refusal(&mut self, refusal: &Status) {
        self.data_losses += u64::from(is_data_loss(refusal));
    }
}

/// True if a refusal says that NATS has lost something. Refusals that leave the outcome open are
/// expected, and those of a full disk. Any other one means a loss, because the points that a client knows are there.
pub(super) fn is_data_loss(refusal: &Status) -> bool {
    let is_full =
        refusal.code() == Code::ResourceExhausted && Refusal::of(refusal).reason == "DISK_FULL";
    let is_expected = matches!(
        refusal.code(),
        Code::Unavailable
            | Code::Unknown
            | Code::Internal
            | Code::Cancelled
            | Code::DeadlineExceeded
            | Code::DataLoss
    );
    assert!(is_expected || is_full, "{refusal:?}");
    refusal.code() == Code::DataLoss
}

/// Connects as a client that leaves a server which stands still.
pub(super) async fn connect(uri: &str) -> Result<Stubs, tonic::transport::Error> {
    let endpoint = Endpoint::from_shared(uri.to_owned()).expect("a URI");
    let endpoint = endpoint
        .connect_timeout(MAX_SILENCE)
        .http2_keep_alive_interval(MAX_SILENCE);
    Stubs::open(&endpoint.keep_alive_timeout(MAX_SILENCE)).await
}
