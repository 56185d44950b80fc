//! Servers that share a journal in NATS, while servers of both kinds fail under their writers: each acknowledged mutation
//! takes effect once, all servers have the same points, and the history of the clients holds.
//!
//! The load of one index, `arm`:
//!
//! - Eight writers make one call after another, at one server after another, and repeat a call without an outcome. Four of them
//!   insert and remove, and tag the points that all change by compare-and-set. The others write batches in sessions, and tag
//!   these points there. After some batches they open another session, and repeat the last batch of the one before.
//! - Between their mutations the writers read, the latest or what the server has.
//! - A follower gets the record of each mutation by `Watch`, at one server after another.
//!
//! Two makers create, fill, read and delete another index, again and again under one name.
//!
//! A run is a sequence of rounds, each with servers, clients and a seed of its own. After each fault the clients pause, and
//! `VerifyIndex` compares the servers as they run. In every second round the journal is not trimmed. A round ends if JetStream
//! has stopped for good, by the logs of its own servers: then reads go on, and the copies have all that was acknowledged. While
//! a server of NATS is away and the store of another one was damaged, nothing need be acknowledged; once all run again it must
//! be. `tests/cluster/run` starts it.

mod client;
mod clock;
mod damage;
mod disk;
mod fault;
mod follower;
mod history;
mod judge;
mod maker;
mod names;
mod network;
mod notices;
mod record;
mod servers;
mod suffer;

use std::{
    cell::Cell,
    collections::BTreeSet,
    env,
    sync::Arc,
    time::{Duration, Instant, SystemTime},
};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::json;
use tokio::{sync::watch, task::JoinSet, time::timeout};
use wayfold_tests::Stubs;

use client::{Client, Scene};
use disk::Disk;
use fault::{Fault, Needs, Stall};
use follower::Following;
use history::History;
use judge::{Judge, Witnesses};
use maker::Maker;
use record::Record;
use servers::{Cluster, SERVERS};

use crate::clients::{Load, SPACE, Writer};

const WRITERS: u64 = 8;
/// The points that all writers change.
const CONTESTED: usize = 2;
/// The clients of the index that is created and deleted again and again.
const MAKERS: u64 = 2;
const LOAD: Load = Load {
    rows: 20,
    // Such a call takes several messages of NATS.
    heavy: 0.05,
    removals: 0.2,
};
/// The number of faults, unless the environment variable `CLUSTER_FAULTS` sets another: one of each that needs no root.
const FAULTS: u64 = 9;
const FAULTS_A_ROUND: u64 = 20;
/// The seed, unless `CLUSTER_SEED` sets another.
const SEED: u64 = 5;
/// The kinds of faults, unless `CLUSTER_KINDS` sets others.
const KINDS: &str = "plain";
/// The time in which writing goes on after a fault; NATS alone may take ten seconds to choose another leader.
const MAX_PAUSE: Duration = Duration::from_secs(60);

fn variable(name: &str, default: u64) -> u64 {
    env::var(name).map_or(default, |value| value.parse().unwrap())
}

/// A run, by its seed.
struct Run {
    seed: u64,
    /// The list of the kinds as it was given.
    list: String,
    kinds: Vec<Fault>,
    record: Record,
}

impl Run {
    /// Causes the faults of these numbers under writers, and judges what the clients saw.
    async fn round(&self, round: u64, faults: std::ops::Range<u64>) {
        let seed = self.seed.wrapping_mul(1_000_003).wrapping_add(round);
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        // Records that NATS loses come back from what is not trimmed.
        let trims = round.is_multiple_of(2) && env::var_os("CLUSTER_NATS_SYNC").is_none();
        let mut cluster = Cluster::start(&self.kinds, trims);
        let first = cluster.uris.lock().unwrap()[0].clone();
        let history = History::new();
        let mut stubs = Stubs::connect(&first).await;
        let uid = stubs.create("arm", SPACE).await.revision.unwrap().uid;
        let mut writers: Vec<_> = (0..WRITERS)
            .map(|name| Writer::new(name, seed, LOAD))
            .collect();
        for writer in writers.iter_mut().skip(1).step_by(2) {
            writer.open_session(&mut stubs, &uid).await;
        }
        let contested = writers[0].store_contested(&mut stubs, CONTESTED).await;
        for writer in &mut writers {
            writer.compete(&contested);
        }
        // NATS that does not sync each record keeps the streams at least.
        cluster.disks.iter().for_each(Disk::sync);
        let (acknowledged, over) = (watch::Sender::new(0), watch::Sender::new(false));
        let scene = Scene {
            uid: uid.clone(),
            uris: Arc::clone(&cluster.uris),
            history,
            acknowledged: acknowledged.clone(),
            over: over.subscribe(),
            calling: Arc::default(),
        };
        let (judge, calling) = (Judge::new(history, uid), Arc::clone(&scene.calling));
        let (mut working, mut making) = (JoinSet::new(), JoinSet::new());
        for writer in writers {
            working.spawn(Client::new(writer).work(scene.clone()));
        }
        for maker in 0..MAKERS {
            making.spawn(Maker::new(maker, seed, history).work(scene.clone()));
        }
        let following = Following::start(&scene, WRITERS + SERVERS as u64, seed);
        let mut at = acknowledged.subscribe();
        let stalled = Cell::new(None);
        // The number of acknowledgements, and the time at which the last one was seen.
        let last = Cell::new((0, SystemTime::now()));
        let mut reach_more = async |more: u64, stall: Stall| {
            let target = *at.borrow() + more;
            let is_reached = |&now: &u64| {
                if now > last.get().0 {
                    last.set((now, SystemTime::now()));
                }
                now >= target
            };
            if stalled.get().is_none() {
                let reached = timeout(MAX_PAUSE, at.wait_for(is_reached)).await;
                stalled.set(reached.is_err().then_some(stall));
            }
        };
        let (mut suffered, mut divergent) = (0, 0);
        // The servers of NATS whose stores are damaged: two of three copies are no majority until they have caught up.
        let mut damaged = BTreeSet::new();
        for number in faults.clone().take_while(|_| stalled.get().is_none()) {
            let fault = Fault::of(number, &self.kinds, &mut random);
            reach_more(random.random_range(20..100), Stall::Before).await;
            if stalled.get().is_some() {
                // The repair of a fault could end the stall, and a server without NATS does not start.
                break;
            }
            suffered += 1;
            let of = random.random_range(0..SERVERS);
            println!("{fault:?} of {of}");
            let began = Instant::now();
            let what = cluster
                .suffer(fault, of, &mut random, async || {
                    reach_more(20, Stall::Under).await
                })
                .await;
            let stall = stalled.get();
            let lacks_majority = stall.is_some_and(|it| fault.excuses(it, of, &damaged));
            if lacks_majority {
                // All of them run again.
                stalled.set(None);
                reach_more(20, Stall::Under).await;
            }
            if !cluster.is_whole() {
                // A server ends if NATS does not answer when it starts.
                stalled.set(stalled.get().or(Some(Stall::Under)));
            }
            if fault.takes_nats() && !lacks_majority {
                // The others have caught up: writing went on with them.
                damaged.retain(|it| *it == of || fault.needs() == Needs::Network);
            }
            if fault.damages_nats() {
                damaged.insert(of);
            }
            self.record.append(&json!({
                "seed": self.seed, "fault": number, "kind": format!("{fault:?}"), "of": of, "what": what,
                "lacked_majority": lacks_majority,
                "acknowledged": *acknowledged.borrow(), "seconds": began.elapsed().as_secs_f32(),
            }));
            if stalled.get().is_none() {
                // The restart at the end of the round would hide a server that has stopped or differs.
                let _silence = calling.write().await;
                match judge.compare(&cluster.live_uris(), &following).await {
                    Some(differing) => divergent += differing,
                    None => stalled.set(Some(Stall::After)),
                }
            }
        }
        if stalled.get().is_none() {
            // The restart would hide a server that has not heard of the last change.
            let _silence = calling.write().await;
            divergent += u64::from(names::agreed(&cluster.live_uris()).await.is_none());
        }
        over.send_replace(true);
        let has_stopped = stalled.get().is_some() || !cluster.kill_all();
        if has_stopped {
            assert!(
                cluster.has_jetstream_stopped(last.get().1),
                "nothing is acknowledged any more, or a server does not start"
            );
        }
        let witnesses = Witnesses {
            clients: working.join_all().await,
            makers: making.join_all().await,
            following,
        };
        let mut verdict = match has_stopped {
            true => judge.judge_reads(witnesses, &cluster.live_uris()).await,
            false => judge.judge(witnesses, &cluster.live_uris()).await,
        };
        verdict.divergent += divergent;
        for server in 0..SERVERS {
            cluster.kill(server);
        }
        // A server that refuses calls because NATS has lost something says so in its log. Names that NATS has lost may be given
        // again.
        let is_noticed = (verdict.data_losses == 0 || cluster.notices.tell_of_loss())
            && (verdict.name_violations.is_empty() || cluster.notices.tell_of_lost_names());
        let is_good = verdict.is_good() && is_noticed && cluster.notices.panics() == 0;
        self.record.append(&json!({
            "seed": self.seed, "kinds": self.list, "round": round, "faults": suffered, "trims": trims,
            "jetstream_stopped": has_stopped,
            "ok": is_good, "acknowledged": verdict.acknowledged, "latest": verdict.checked.latest,
            "plain": verdict.checked.plain, "conflicts": verdict.checked.conflicts,
            "records": verdict.checked.records, "resets": verdict.resets,
            "indexes": verdict.names.indexes, "deleted": verdict.names.deleted,
            "points_of_names": verdict.names.acknowledged, "reads_of_names": verdict.names.reads,
            "lost": verdict.lost, "twice": verdict.twice,
            "divergent": verdict.divergent, "data_losses": verdict.data_losses,
            "violations": verdict.violations, "name_violations": verdict.name_violations,
            "notices": cluster.notices.counts(),
        }));
        if !is_good {
            let lines = cluster.notices.lines.join("\n");
            panic!("{verdict:?}\n{lines}");
        }
    }
}

#[ignore = "needs nats-server"]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn servers_that_share_a_journal_lose_and_double_nothing() {
    let seed = variable("CLUSTER_SEED", SEED);
    let list = env::var("CLUSTER_KINDS").unwrap_or_else(|_| KINDS.into());
    println!("seed {seed}, faults {list}");
    let run = Run {
        record: Record::open(seed, &list),
        kinds: Fault::parse(&list),
        seed,
        list,
    };
    let faults = variable("CLUSTER_FAULTS", FAULTS);
    for round in 0..faults.div_ceil(FAULTS_A_ROUND) {
        let first = round * FAULTS_A_ROUND;
        if !run.record.has(round) {
            run.round(round, first..faults.min(first + FAULTS_A_ROUND))
                .await;
        }
    }
}
