//! The disk fails under a running server and comes back. Writes are refused with a clear status, no mutation is half
//! applied, reads go on, and the same process writes again once the disk works.

mod disk;
mod operator;
mod start;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tonic::{Code, Status};
use wayfold_proto::v1::{CreateIndexRequest, create_index_request::SpaceForm};
use wayfold_tests::{Refusal, ServerProcess, Signal, Stubs};

use self::disk::Disk;
use crate::clients::{Clients, FaultTime, Load};

const LOAD: Load = Load {
    rows: 10,
    heavy: 0.05,
    removals: 0.2,
};
/// A load that makes the store move points out of its journal within a few hundred calls.
const HEAVY_LOAD: Load = Load {
    rows: 10,
    heavy: 0.9,
    removals: 0.1,
};
const SEED: u64 = 7;
/// The number of failures of each kind, unless the environment variable `DISK_FAILURES` sets another.
const FAILURES: u64 = 1;
/// The number of reads by each reader during a failure.
const READS: usize = 40;
/// The server logs this once it writes again.
const RECOVERED: &str = "the log is writable again";

fn failures() -> u64 {
    std::env::var("DISK_FAILURES").map_or(FAILURES, |failures| failures.parse().unwrap())
}

fn check_refusals(refusals: &[Status]) {
    for status in refusals {
        let refusal = Refusal::of(status);
        assert_eq!(
            (refusal.code, &*refusal.reason),
            (Code::Unavailable, "STORAGE_FAILED"),
            "{status:?}"
        );
    }
}

/// A server on a failing disk, and its clients.
struct Scene {
    disk: Disk,
    server: ServerProcess,
    clients: Clients,
    random: ChaCha8Rng,
}

impl Scene {
    async fn new(load: Load) -> Self {
        println!("seed {SEED}");
        let disk = Disk::new();
        let server = disk.serve();
        Self {
            clients: Clients::new(&server, SEED, load).await,
            disk,
            server,
            random: ChaCha8Rng::seed_from_u64(SEED),
        }
    }

    /// Runs all clients; at some moment the disk begins to fail, and it still fails when each writer was refused.
    async fn fail(&mut self, how: &str) {
        let moment = FaultTime::Acknowledged(self.random.random_range(1..150));
        let (clients, disk) = (&mut self.clients, &self.disk);
        let refusals = clients.work_until_refused(&self.server, moment, || disk.fail(how));
        let refusals = refusals.await;
        check_refusals(&refusals);
        for status in refusals {
            let message = status.message();
            // The second answer comes while the server reopens the store.
            let says_what_to_do =
                message.contains("tries repeatedly") || message.contains("retry it");
            assert!(says_what_to_do, "{message}");
        }
    }

    /// While the disk fails, the server refuses every write and answers every read.
    async fn look(&mut self) {
        self.clients.look(&self.server, READS).await;
        let refused = self.clients.ask_again(&self.server).await;
        assert_eq!(refused, Clients::WRITERS);
        self.clients.look(&self.server, READS).await;
        let refused = self.clients.refused_reads();
        assert!(refused.is_empty(), "{refused:?}");
    }

    /// The refusal of a write contains the message of the disk's error.
    async fn check_reason(&self, reason: &str) {
        let mut stubs = Stubs::connect(self.server.uri()).await;
        let request = CreateIndexRequest {
            name: "other".into(),
            space_form: Some(SpaceForm::SpaceText("R1".into())),
            ..Default::default()
        };
        let refused = stubs.indexes.create_index(request).await.unwrap_err();
        assert!(refused.message().contains(reason), "{refused:?}");
        check_refusals(&[refused]);
    }

    /// The disk comes back. While the store reopens, reads of its content are refused and must be repeated.
    async fn recover(&mut self) {
        let disk = &self.disk;
        let recovered = self.clients.look_during(&mut self.server, |server| {
            disk.mend();
            server.log_until(RECOVERED);
        });
        recovered.await;
        check_refusals(&self.clients.refused_reads());
        self.clients.check(&self.server).await;
    }

    /// Nothing is missing after a restart either.
    async fn end(mut self) {
        self.server.stop(Signal::Kill);
        self.clients.check(&self.disk.serve()).await;
        println!("{}", self.clients.tally());
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_disk_that_fails_and_comes_back_costs_no_acknowledged_mutation() {
    let mut scene = Scene::new(LOAD).await;
    for _ in 0..failures() {
        for how in ["full 28", "torn 28", "readonly 30", "full 5", "syncs 5"] {
            scene.fail(how).await;
            scene.look().await;
            scene.recover().await;
        }
    }
    scene.end().await;
}

/// The disk has some room, but not for the points that the store moves out of its journal.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_disk_without_the_room_that_the_store_needs_is_waited_for() {
    let mut scene = Scene::new(HEAVY_LOAD).await;
    for _ in 0..failures() {
        scene.fail("large 28 8000000").await;
        scene.server.log_until("cannot reopen the log yet");
        scene.check_reason("No space left on device").await;
        scene.look().await;
        scene.recover().await;
    }
    scene.end().await;
}

/// Probes of the disk succeed, and only the writes out of the journal fail. The server reopens the store repeatedly,
/// and searches go on.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_store_that_fails_on_a_disk_that_looks_well_recovers_once_it_can() {
    let mut scene = Scene::new(HEAVY_LOAD).await;
    for how in ["full 28 /tables/", "syncs 5 /keyspaces/"] {
        scene.fail(how).await;
        for _ in 0..10 {
            scene.clients.look(&scene.server, READS).await;
            scene.clients.ask_again(&scene.server).await;
        }
        check_refusals(&scene.clients.refused_reads());
        scene.disk.mend();
        let mut tries = 0;
        while scene.clients.ask_again(&scene.server).await > 0 {
            assert!(tries < 20, "it does not recover");
            tries += 1;
            tokio::task::block_in_place(|| scene.server.log_until(RECOVERED));
        }
        scene.clients.check(&scene.server).await;
    }
    scene.end().await;
}
