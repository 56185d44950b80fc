//! A follower of the index: it gets each record by `Watch`, at one server after the other, and keeps a copy of the points.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::{Duration, Instant},
};

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use tokio::{
    sync::watch,
    task::{JoinHandle, yield_now},
    time::timeout,
};
use tonic::Status;
use wayfold_proto::v1::{Mutation, ResetReason, ScanRequest, WatchRequest};
use wayfold_tests::{
    Content, INCLUDE_ALL, Stubs,
    history::{Call, Operation, Point, ReadPoints},
    number, revision,
};

use super::{
    MAX_PAUSE,
    client::{Scene, connect, is_data_loss},
    history::{content_points, scan, told_points},
};

/// A follower moves to another server after this many messages.
const MESSAGES_A_SERVER: usize = 50;
/// The time between the calls of one client, which do not overlap.
const INSTANT: Duration = Duration::from_nanos(1);

/// A follower that runs.
pub(super) struct Following {
    /// The newest revision that it has.
    reached: watch::Receiver<u64>,
    over: watch::Sender<bool>,
    task: JoinHandle<Follower>,
}

impl Following {
    /// Starts a follower, which is this client of the history.
    pub(super) fn start(scene: &Scene, client: u64, seed: u64) -> Self {
        let (over, reached) = (watch::Sender::new(false), watch::Sender::new(0));
        let follower = Follower {
            client,
            seen: Vec::new(),
            resets: 0,
            data_losses: 0,
            random: ChaCha8Rng::seed_from_u64(seed),
            points: BTreeMap::new(),
            revision: 0,
            returned: Instant::now(),
            reached: reached.clone(),
        };
        let scene = Scene {
            over: over.subscribe(),
            ..scene.clone()
        };
        Self {
            reached: reached.subscribe(),
            over,
            task: tokio::spawn(follower.follow(scene)),
        }
    }

    /// Waits until it has a revision; false if it does not get there.
    pub(super) async fn reaches(&self, revision: u64) -> bool {
        let mut reached = self.reached.clone();
        let waited = timeout(MAX_PAUSE, reached.wait_for(|at| *at >= revision)).await;
        let reaches = matches!(waited, Ok(Ok(_)));
        if !reaches {
            println!("the follower does not reach revision {revision}");
        }
        reaches
    }

    /// Ends it. What it saw ends with a read of its copy.
    pub(super) async fn end(self) -> Follower {
        self.over.send_replace(true);
        self.task.await.unwrap()
    }
}

/// See the module.
pub(super) struct Follower {
    client: u64,
    /// The records that it got, and the reads of all points with which it began again.
    pub(super) seen: Vec<Operation>,
    /// The times that a server no longer kept its next record.
    pub(super) resets: u64,
    /// The refusals that say that NATS has lost something.
    pub(super) data_losses: u64,
    random: ChaCha8Rng,
    /// Its copy, and the revision of that.
    points: BTreeMap<u64, Point>,
    revision: u64,
    /// The time of its last answer.
    returned: Instant,
    reached: watch::Sender<u64>,
}

/// A record, as far as its pieces have come.
#[derive(Default)]
struct Pieces {
    count: u32,
    stored: BTreeMap<u64, Point>,
    removed: BTreeSet<u64>,
}

impl Follower {
    /// Follows until it is over.
    async fn follow(mut self, scene: Scene) -> Self {
        let mut over = scene.over.clone();
        while !*over.borrow() {
            let uri = scene.choose_server(&mut self.random);
            tokio::select! {
                _ = over.changed() => {}
                followed = self.follow_at(&uri, &scene) => {
                    if let Err(refusal) = followed {
                        self.data_losses += u64::from(is_data_loss(&refusal));
                    }
                }
            }
            yield_now().await;
        }
        let copy = Call::Read {
            latest: false,
            revision: self.revision,
            seen: ReadPoints::All(self.points.clone()),
        };
        self.note(&scene, copy);
        self
    }

    /// Follows at one server until that fails, or for as long as it stays.
    async fn follow_at(&mut self, uri: &str, scene: &Scene) -> Result<(), Status> {
        let Ok(stubs) = connect(uri).await else {
            return Ok(());
        };
        let request = WatchRequest {
            index_name: "arm".into(),
            after_revision: revision(&scene.uid, self.revision),
            include: Some(INCLUDE_ALL),
            own_session: 0,
        };
        let watching = stubs.points.clone().watch(request).await?;
        let (mut messages, mut pieces) = (watching.into_inner(), Pieces::default());
        for _ in 0..MESSAGES_A_SERVER {
            let Some(message) = messages.message().await? else {
                return Ok(());
            };
            if message.reset.is_some() {
                assert_eq!(message.reset(), ResetReason::WindowPassed, "{message:?}");
                return self.begin_again(&stubs, scene).await;
            }
            for piece in &message.mutations {
                if let Some(record) = pieces.join(piece, &scene.uid) {
                    self.take(scene, number(&piece.revision), record);
                }
            }
        }
        Ok(())
    }

    /// Takes a record into the copy.
    fn take(&mut self, scene: &Scene, revision: u64, record: Pieces) {
        let Pieces {
            stored, removed, ..
        } = record;
        for id in &removed {
            self.points.remove(id);
        }
        self.points.extend(stored.clone());
        let record = Call::Record {
            revision,
            stored,
            removed,
        };
        self.has_reached(scene, revision, record);
    }

    /// Reads all points, since the server does not keep the next record.
    async fn begin_again(&mut self, stubs: &Stubs, scene: &Scene) -> Result<(), Status> {
        let request = ScanRequest {
            index_name: "arm".into(),
            include: Some(INCLUDE_ALL),
            min_revision: revision(&scene.uid, self.revision),
            ..Default::default()
        };
        let content = Content::read_as(stubs, request).await?;
        self.resets += 1;
        self.points = content_points(&content);
        self.has_reached(scene, content.revision, scan(false, &content));
        Ok(())
    }

    fn has_reached(&mut self, scene: &Scene, revision: u64, call: Call) {
        self.revision = revision;
        self.note(scene, call);
        self.reached.send_replace(revision);
    }

    fn note(&mut self, scene: &Scene, call: Call) {
        let invoked = self.returned + INSTANT;
        self.returned = Instant::now().max(invoked);
        let seen = scene
            .history
            .operation(self.client, invoked, self.returned, call);
        self.seen.push(seen);
    }
}

impl Pieces {
    /// Adds a piece, and returns the record if it is whole.
    fn join(&mut self, piece: &Mutation, uid: &str) -> Option<Self> {
        let named = piece.revision.as_ref().expect("a revision");
        assert_eq!((&*named.uid, piece.piece), (uid, self.count));
        self.count += 1;
        self.stored
            .extend(piece.stored.iter().flat_map(told_points));
        self.removed.extend(&piece.removed_ids);
        (!piece.continued).then(|| std::mem::take(self))
    }
}
