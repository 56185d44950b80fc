//! Runs of a server in which indices are created, changed, read, copied, deleted and restored. All answers agree with
//! the models.

mod expected;
mod server_run;

use std::{env, ops::Range};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold_server::{
    registry::RegistryOptions,
    service::{Limits, Service},
};

use crate::{
    fault::FaultLog,
    store::{End, Store},
    support::*,
};
use expected::Expected;
use server_run::ServerRun;

const SERVER_RUNS: u64 = 6;

/// The seeds of `SEEDS` runs, or the one in `SEED`.
fn seeds(usual: u64) -> Range<u64> {
    let number = |name| env::var(name).ok().map(|text| text.parse::<u64>().unwrap());
    match number("SEED") {
        Some(seed) => seed..seed + 1,
        None => 0..number("SEEDS").unwrap_or(usual),
    }
}

/// Runs a server several times and returns the number of restored indices.
fn run(seed: u64, mut store: Store) -> u64 {
    let mut world = Expected::new(ChaCha8Rng::seed_from_u64(seed));
    for life in 0..SERVER_RUNS {
        let end = world.pick(&[End::Orderly, End::Crash]);
        println!("  start {life}, which ends in {end:?}");
        // Dropping the runtime ends all tasks of the server.
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build();
        let left = runtime.unwrap().block_on(async {
            let steps = world.random.random_range(20..80);
            let mut life = ServerRun::begin(&mut world, started(&store)).await;
            for _ in 0..steps {
                life.step().await;
            }
            life.is_as_it_must().await;
            // Snapshots and restores are under way at this point.
            store.left(end)
        });
        world.forget();
        store.close(end);
        store = left.unwrap_or(store);
    }
    world.restored
}

fn started(store: &Store) -> Service {
    let options = RegistryOptions {
        // A small window makes the server trim old records.
        window_bytes: 500,
        ..options()
    };
    restarted_with(store.open(), options, Limits::default())
}

/// Runs every seed over a store of its own.
fn run_all(place: &str, usual: u64, store: impl Fn(u64) -> Store) {
    let seeds = seeds(usual);
    let restored: u64 = seeds
        .clone()
        .map(|seed| {
            println!("SEED={seed} {place}");
            run(seed, store(seed))
        })
        .sum();
    println!("{restored} indices restored {place}");
    // A single run rarely restores no index.
    assert!(restored >= seeds.end - seeds.start || seeds.end - seeds.start == 1);
}

#[test]
fn indices_agree_with_their_models_in_memory() {
    run_all("in memory", 40, |_| Store::in_memory());
}

#[test]
fn indices_agree_with_their_models_on_disk() {
    run_all("on disk", 10, |_| Store::on_disk());
}

#[test]
fn indices_agree_with_their_models_across_losses_of_power() {
    run_all("on a disk that loses its power", 40, |seed| {
        Store::Faulty(FaultLog::new(seed))
    });
}
