//! Acknowledged durable inserts per second of 64 clients, one state each.

use std::{collections::BTreeMap, process, time::Instant};

use serde_json::json;
use tokio::task::JoinSet;
use wayfold_server::log::Durability;
use wayfold_tests::{
    ServerProcess, States, Stubs,
    figures::{median, processor_seconds},
    measuring,
    report::{Goal, Report},
};

use crate::{
    CLIENTS, INDEX, K, SPACE, WIDTH,
    bare::{self, BareStore},
    base_directory::BaseDirectory,
    service::{LocalService, WINDOW_BYTES, insertion},
    shape::Shape,
};

/// The numbers of connections that the clients share evenly: one for each client, and a few, as from processes with
/// many tasks.
const CONNECTIONS: [usize; 2] = [CLIENTS, 4];

/// States of one client; they are inserted over and over, under new ids.
const POOL: usize = 1024;

/// The result of one round of one contestant.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Round {
    /// Inserted states per second.
    pub(crate) rate: f64,
    /// Processor time per state, in microseconds. The server's comes first if it is another process.
    pub(crate) processor_us: (f64, f64),
}

/// A contestant of the measurement.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Contestant {
    BareStore(bare::SyncSharing),
    Service(Option<u32>),
    /// The first number is that of the connections.
    Grpc(usize, Option<u32>),
    Echo(usize, Option<u32>),
}

/// Measures inserts of one state: `count` of them in each of `rounds`.
pub(crate) async fn measure(
    base: &BaseDirectory,
    shape: &Shape,
    (rounds, count): (usize, usize),
    report: &mut Report,
) {
    let mut taken = BTreeMap::<Contestant, Vec<Round>>::new();
    for round in 0..rounds {
        // The contestants take turns, so that other load on the machine affects all of them.
        for way in bare::SyncSharing::ALL {
            let bare = BareStore::open(base, shape, way);
            let meter = Meter::start(None, count);
            bare.write(count).await;
            taken
                .entry(Contestant::BareStore(way))
                .or_default()
                .push(meter.stop());
        }
        for k in [None, Some(K)] {
            let service = through_service(base, round, count, k).await;
            taken
                .entry(Contestant::Service(k))
                .or_default()
                .push(service);
            for over in CONNECTIONS {
                let (server, echo) = through_grpc(base, (round, over), count, k).await;
                let grpc = taken.entry(Contestant::Grpc(over, k)).or_default();
                grpc.push(server);
                taken
                    .entry(Contestant::Echo(over, k))
                    .or_default()
                    .push(echo);
            }
        }
    }
    let taken = taken.into_iter();
    let medians = taken.map(|(contestant, rounds)| (contestant, middle(&rounds)));
    tell(&medians.collect(), shape, report);
}

fn middle(rounds: &[Round]) -> Round {
    let of = |part: fn(&Round) -> f64| median(rounds.iter().map(part).collect());
    Round {
        rate: of(|round| round.rate),
        processor_us: (
            of(|round| round.processor_us.0),
            of(|round| round.processor_us.1),
        ),
    }
}

fn tell(medians: &BTreeMap<Contestant, Round>, shape: &Shape, report: &mut Report) {
    report.section(
        "acknowledged durable inserts/s, 64 clients, one state each",
        "bare fjall",
    );
    let of = |contestant| medians.get(&contestant).copied().unwrap_or_default();
    let mut best = 0.0f64;
    for way in bare::SyncSharing::ALL {
        let round = of(Contestant::BareStore(way));
        report.note(&format!("bare fjall: {}", way.name()), round.rate, "/s");
        if way != bare::SyncSharing::FileSync {
            best = best.max(round.rate);
        }
    }
    let file_sync = of(Contestant::BareStore(bare::SyncSharing::FileSync)).rate;
    for (k, with) in [(None, ""), (Some(K), ", k = 10")] {
        let service = of(Contestant::Service(k));
        report.ratio(
            &format!("service layer{with}"),
            service.rate,
            best,
            "/s",
            Goal::AtLeast(0.9),
        );
        report.compare(
            &format!("  to bare fjall synced beside{with}"),
            service.rate,
            file_sync,
            "/s",
        );
        report.note(
            &format!("  processor an insert{with}"),
            service.processor_us.1,
            "us",
        );
        for over in CONNECTIONS {
            let measured = (of(Contestant::Grpc(over, k)), of(Contestant::Echo(over, k)));
            tell_grpc(measured, best, &format!("{over} connections{with}"), report);
        }
    }
    report.data("bytes an insert", json!(shape.bytes()));
}

/// Reports the server's figures, and the echo's for comparison.
fn tell_grpc((grpc, echo): (Round, Round), bare: f64, with: &str, report: &mut Report) {
    let goal = Goal::AtLeast(0.7);
    report.ratio(&format!("gRPC, {with}"), grpc.rate, bare, "/s", goal);
    report.compare(
        &format!("  to a bare echo of the same messages, {with}"),
        grpc.rate,
        echo.rate,
        "/s",
    );
    report.compare(
        &format!("  the bare echo to bare fjall, {with}"),
        echo.rate,
        bare,
        "/s",
    );
    for (what, round) in [("gRPC", grpc), ("echo", echo)] {
        let (server, client) = round.processor_us;
        for (whose, processor) in [("server", server), ("client", client)] {
            let what = format!("  processor an insert: {what}, {whose}, {with}");
            report.note(&what, processor, "us");
        }
    }
}

/// Measures the time of `count` inserts.
struct Meter {
    count: f64,
    server: Option<u32>,
    began: Instant,
    processor: (f64, f64),
}

impl Meter {
    fn start(server: Option<&ServerProcess>, count: usize) -> Self {
        let server = server.map(|server| server.process().id());
        Self {
            count: count as f64,
            server,
            processor: processors(server),
            began: Instant::now(),
        }
    }

    fn stop(self) -> Round {
        let seconds = self.began.elapsed().as_secs_f64();
        let (server, client) = processors(self.server);
        let each = |seconds: f64| seconds * 1e6 / self.count;
        Round {
            rate: self.count / seconds,
            processor_us: (
                each(server - self.processor.0),
                each(client - self.processor.1),
            ),
        }
    }
}

/// The processor time of a server, and of this process.
fn processors(server: Option<u32>) -> (f64, f64) {
    let of = |process| processor_seconds(process).unwrap_or_default();
    (server.map_or(0.0, of), of(process::id()))
}

fn pool(client: usize, round: usize) -> Vec<f64> {
    let seed = (round * CLIENTS + client) as u64;
    States::new(SPACE.parse().expect("a space"), seed).rows(POOL)
}

async fn through_service(
    base: &BaseDirectory,
    round: usize,
    count: usize,
    k: Option<u32>,
) -> Round {
    let directory = base.create();
    let hosting = LocalService::open(directory.path(), Durability::Fsync, WINDOW_BYTES);
    hosting.create(INDEX).await;
    let pools = (0..CLIENTS).map(|client| pool(client, round)).collect();
    write(&hosting, pools, (count, 1), k).await
}

/// Measures the insert of `count` states, `batch` a call, by a client for each pool of states.
pub(crate) async fn write(
    service: &LocalService,
    pools: Vec<Vec<f64>>,
    (count, batch): (usize, usize),
    k: Option<u32>,
) -> Round {
    let meter = Meter::start(None, count);
    let mut clients = JoinSet::new();
    for pool in pools {
        let service = service.clone();
        clients.spawn(async move {
            let batches = pool.chunks_exact(batch * WIDTH).cycle();
            for states in batches.take(count / CLIENTS / batch) {
                let inserted = service.insert(insertion(states, k)).await;
                assert_eq!(inserted.ids.len(), batch);
            }
        });
    }
    clients.join_all().await;
    meter.stop()
}

/// The rounds of the server and of the echo.
async fn through_grpc(
    base: &BaseDirectory,
    round: (usize, usize),
    count: usize,
    k: Option<u32>,
) -> (Round, Round) {
    let directory = base.create();
    let data = directory.path().join("data").to_string_lossy().into_owned();
    let server = measuring::server(&data);
    Stubs::connect(server.uri())
        .await
        .create(INDEX, SPACE)
        .await;
    let ours = call(&server, round, count, k).await;
    drop(server);
    let echo = measuring::echo();
    (ours, call(&echo, round, count, k).await)
}

async fn call(
    server: &ServerProcess,
    (round, connections): (usize, usize),
    count: usize,
    k: Option<u32>,
) -> Round {
    let mut connected = Vec::new();
    for _ in 0..connections {
        connected.push(Stubs::connect(server.uri()).await);
    }
    let clients = (0..CLIENTS).map(|client| {
        let stubs = connected[client % connections].clone();
        (stubs, pool(client, round))
    });
    let ready: Vec<_> = clients.collect();
    let meter = Meter::start(Some(server), count);
    let mut clients = JoinSet::new();
    for (mut stubs, pool) in ready {
        clients.spawn(async move {
            let rows = pool.chunks_exact(WIDTH).cycle();
            for row in rows.take(count / CLIENTS) {
                let inserted = stubs.insert(insertion(row, k)).await;
                assert_eq!(inserted.ids.len(), 1);
            }
        });
    }
    clients.join_all().await;
    meter.stop()
}
