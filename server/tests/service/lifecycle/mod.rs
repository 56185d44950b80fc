//! Lives of a server: indices are created, changed, read, copied, deleted and restored from their copies, from start to
//! start. All of it agrees with the models.

mod life;
mod mutation;
mod store;
mod world;

use std::{env, ops::Range, sync::Arc};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold_server::{
    log::MemoryLog,
    registry::RegistryOptions,
    service::{Limits, Service},
};

use crate::{fault::FaultLog, support::*};
use life::Life;
use store::{End, Store};
use world::World;

const LIVES: u64 = 6;

/// The seeds of `SEEDS` runs, or the one in `SEED`.
fn seeds(usual: u64) -> Range<u64> {
    let number = |name| env::var(name).ok().map(|text| text.parse::<u64>().unwrap());
    match number("SEED") {
        Some(seed) => seed..seed + 1,
        None => 0..number("SEEDS").unwrap_or(usual),
    }
}

/// How many indices were restored.
fn run(seed: u64, mut store: Store) -> u64 {
    let mut world = World::new(ChaCha8Rng::seed_from_u64(seed));
    for life in 0..LIVES {
        let end = world.pick(&[End::Orderly, End::Crash]);
        println!("  start {life}, which ends in {end:?}");
        // With the runtime all that the server has under way ends.
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build();
        let left = runtime.unwrap().block_on(async {
            let steps = world.random.random_range(20..80);
            let mut life = Life::begin(&mut world, started(&store)).await;
            for _ in 0..steps {
                life.step().await;
            }
            life.is_as_it_must().await;
            // With snapshots and restores under way.
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
        // So that old records go.
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
    // Few single runs restore none.
    assert!(restored >= seeds.end - seeds.start || seeds.end - seeds.start == 1);
}

#[test]
fn whatever_a_server_lives_through_in_memory_its_indices_are_as_they_must() {
    run_all("in memory", 40, |_| {
        Store::Memory(Arc::new(MemoryLog::new()))
    });
}

#[test]
fn whatever_a_server_lives_through_on_disk_its_indices_are_as_they_must() {
    run_all("on disk", 10, |_| Store::on_disk());
}

#[test]
fn whatever_a_server_lives_through_on_a_disk_without_power_its_indices_are_as_they_must() {
    run_all("on a disk that loses its power", 40, |seed| {
        Store::Faulty(FaultLog::new(seed))
    });
}
