//! A loss of power. The unsynced writes of a server are gone from its files. No mutation that it acknowledged, or
//! showed to a reader, is missing.

mod disk;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold_tests::{Signal, Stubs};

use self::disk::Disk;
use crate::clients::{Clients, FaultTime, Load};

const FSYNC: &[(&str, &str)] = &[("WAYFOLD_DATA__DURABILITY", "fsync")];
/// A few rounds of this load make the store move points out of its journal and begin another.
const LOAD: Load = Load {
    rows: 3,
    heavy: 0.2,
    removals: 0.2,
};
/// The number of losses of power, unless the environment variable `POWER_LOSSES` sets another.
const LOSSES: u64 = 8;
/// The number of failed syncs before a loss, unless that variable is set.
const FAILED_SYNCS: u64 = 3;
const SEED: u64 = 3;
/// The minimum number of lines that a starting server logs.
const LINES: u32 = 4;
/// The approximate number of its calls that change something.
const CALLS: u32 = 40;

fn losses_of_environment() -> Option<u64> {
    let losses = std::env::var("POWER_LOSSES").ok();
    losses.map(|losses| losses.parse().unwrap())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_acknowledged_is_lost_when_the_disk_keeps_only_synced_data() {
    lose_power(Disk::new(None), SEED).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_acknowledged_is_lost_when_the_disk_keeps_some_of_the_rest() {
    lose_power(Disk::new(Some(SEED)), SEED + 1).await;
}

async fn lose_power(mut disk: Disk, seed: u64) {
    println!("seed {seed}");
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut server = disk.serve(FSYNC);
    let mut clients = Clients::new(&server, seed, LOAD).await;
    // On this disk a sync is nearly always under way, and readers read meanwhile.
    clients.tell_of_looks(disk.looked());
    let mut cuts = 0;
    for _ in 0..losses_of_environment().unwrap_or(LOSSES) {
        let moment = match random.random_range(0..4) {
            0 => FaultTime::Built(random.random_range(1..50)),
            _ => FaultTime::Acknowledged(random.random_range(1..200)),
        };
        clients.work(server, moment).await;
        disk.cut();
        cuts += 1;
        // Some starts lose power too.
        while random.random_bool(0.4) {
            let calls = random.random_range(1..CALLS).to_string();
            let cut = [FSYNC, &[("POWER_CUT", &calls)]].concat();
            disk.start(&cut).kill_at_line(random.random_range(0..LINES));
            disk.cut();
            cuts += 1;
        }
        server = disk.serve(FSYNC);
        clients.check(&server).await;
    }
    server.stop(Signal::Terminate);
    disk.check_shadow();
    println!("{cuts} losses of power, {}", clients.tally());
}

/// After a failed sync, the kernel marks the unwritten pages clean, and the next sync succeeds without them.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn data_of_a_failed_sync_is_written_before_more_is_acknowledged() {
    println!("seed {SEED}");
    let mut random = ChaCha8Rng::seed_from_u64(SEED);
    let mut disk = Disk::new(None);
    let mut server = disk.serve(FSYNC);
    let mut clients = Clients::new(&server, SEED, LOAD).await;
    for _ in 0..losses_of_environment().unwrap_or(FAILED_SYNCS) {
        server.stop(Signal::Kill);
        disk.cut();
        let fails = random.random_range(5..50).to_string();
        server = disk.serve(&[FSYNC, &[("POWER_FAILS", &fails)]].concat());
        // The sync may fail before anything was acknowledged.
        let refused = clients.work_until_refused(&server, FaultTime::Acknowledged(0), || ());
        refused.await;
        server.log_until("the log is writable again");
        clients.check(&server).await;
        server.stop(Signal::Kill);
        disk.cut();
        server = disk.serve(FSYNC);
        clients.check(&server).await;
    }
    println!("{}", clients.tally());
}

/// fjall goes on with a journal whose making failed, and does not ask for its name to be durable.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_journal_that_was_made_in_vain_is_found_again() {
    let mut disk = Disk::new(None);
    // Makes the first journal.
    disk.serve(FSYNC).stop(Signal::Kill);
    disk.cut();
    let mut server = disk.serve(&[FSYNC, &[("POWER_FAILS", "new")]].concat());
    let load = Load { heavy: 1.0, ..LOAD };
    let mut clients = Clients::new(&server, SEED, load).await;
    let refused = clients.work_until_refused(&server, FaultTime::Acknowledged(0), || ());
    refused.await;
    server.log_until("the log is writable again");
    clients.check(&server).await;
    server.stop(Signal::Kill);
    disk.cut();
    clients.check(&disk.serve(FSYNC)).await;
    println!("{}", clients.tally());
}

/// After a first start that is killed before any call that makes, writes or syncs something, the next start succeeds.
/// The long run tries each such call, a short run one in a few.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_first_start_may_be_cut_short_anywhere() {
    let mut disk = Disk::new(None);
    let stride = if losses_of_environment().is_some() {
        1
    } else {
        8
    };
    let mut cut_short = true;
    let (mut calls, mut cuts) = (0, 0);
    while cut_short {
        calls += stride;
        disk.erase();
        let at = calls.to_string();
        let cut = [FSYNC, &[("POWER_CUT", &at)]].concat();
        let mut starting = disk.start(&cut);
        cut_short = starting.line().is_none();
        starting.kill_at_line(0);
        disk.cut();
        let server = disk.serve(FSYNC);
        let uid = Stubs::connect(server.uri())
            .await
            .create("arm", "R2")
            .await
            .revision
            .unwrap()
            .uid;
        server.stop(Signal::Kill);
        disk.cut();
        let server = disk.serve(FSYNC);
        let mut stubs = Stubs::connect(server.uri()).await;
        let found = stubs.describe("arm").await.revision.unwrap().uid;
        assert_eq!(found, uid, "cut at call {calls}");
        server.stop(Signal::Kill);
        cuts += u64::from(cut_short);
    }
    println!("{cuts} first starts cut short");
}

/// This is the control: the disk does lose unsynced writes, and the new index has another uid.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn without_syncs_something_is_lost_and_the_uid_is_new() {
    let settings = [("WAYFOLD_DATA__DURABILITY", "none")];
    let load = Load {
        removals: 0.0,
        ..LOAD
    };
    let mut disk = Disk::new(None);
    // A server that ends in order syncs everything, so the index is stored.
    let server = disk.serve(&settings);
    let mut clients = Clients::new(&server, SEED, load).await;
    server.stop(Signal::Terminate);
    disk.check_shadow();
    disk.cut();
    clients
        .work(disk.serve(&settings), FaultTime::Acknowledged(50))
        .await;
    disk.cut();
    let server = disk.serve(&settings);
    let left = clients.count(&server).await;
    println!("one loss of power, {}", clients.tally());
    assert!(clients.tally().lost > 0);
    assert_eq!(clients.tally().duplicated, 0);
    assert_ne!(left.uid, clients.uid());
}
