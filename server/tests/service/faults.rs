//! Any call of the log may fail. Afterwards an acknowledged mutation is stored, a refused one is stored whole or not at
//! all, and reads go on.

use std::sync::Arc;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold_proto::v1;
use wayfold_server::{
    registry::{Registry, RegistryOptions},
    service::{Code, Limits, Service},
};

use crate::{fault::FaultLog, model::Model, random::Mutation, support::*};

const SEEDS: u64 = 4;
const MUTATIONS: u64 = 25;
/// Calls that fail, one in each run. Every mutation makes two at least.
const CALLS: u64 = 60;
/// Every run makes at least this many of these calls.
const MIN_CALLS: u64 = 30;

/// A mutation whose content no other has, so that a part of it is never mistaken for the whole.
fn draw(random: &mut ChaCha8Rng, number: u64, model: &Model) -> Mutation {
    let operation_id = format!("op {number}");
    let mut some = |ids: Vec<u64>, most: usize| {
        let mut drawn: Vec<u64> = (0..most)
            .map(|_| ids[random.random_range(0..ids.len())])
            .collect();
        drawn.sort_unstable();
        drawn.dedup();
        drawn
    };
    let present: Vec<u64> = model.points.keys().copied().collect();
    match number % 5 {
        3 if !present.is_empty() => {
            let ids = some(present, 3);
            Mutation::Update(v1::UpdateRequest {
                index_name: "arm".into(),
                tags: vec![number],
                payloads: ids
                    .iter()
                    .map(|id| format!("{id} again {number}").into())
                    .collect(),
                ids,
                operation_id,
                ..Default::default()
            })
        }
        4 if !present.is_empty() => Mutation::Remove(v1::RemoveRequest {
            operation_id,
            ..removal(&some(present, 2))
        }),
        _ => {
            let ids = some((0..20).collect(), 4);
            let rows: Vec<[f64; 2]> = ids.iter().map(|_| random.random()).collect();
            Mutation::Insert(v1::InsertRequest {
                tags: vec![number; ids.len()],
                payloads: ids
                    .iter()
                    .map(|id| format!("{id} of {number}").into())
                    .collect(),
                on_conflict: v1::OnConflict::Replace.into(),
                operation_id,
                ..insertion(&rows, &ids)
            })
        }
    }
}

fn registry(log: &FaultLog) -> Arc<Registry> {
    // The window is so small that calls of trim occur and may fail too.
    let options = RegistryOptions {
        window_bytes: 500,
        ..options()
    };
    Arc::new(Registry::new(Arc::new(log.clone()), options))
}

fn serving(registry: &Arc<Registry>) -> Service {
    let service = Service::starting(Limits::default());
    service.set_registry(Arc::clone(registry));
    service.set_ready();
    service
}

/// Makes the log's call after `calls` others fail, and returns the number of refused mutations.
async fn run(seed: u64, calls: u64) -> u64 {
    let log = FaultLog::new(seed ^ (calls << 8));
    let registry = registry(&log);
    let service = serving(&registry);
    let uid = create(&service, "arm", "R2").await;
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut model = Model::new("R2".parse().unwrap(), uid);
    let mut refused = 0;
    log.fail_after(calls);
    for number in 0..MUTATIONS {
        let mutation = draw(&mut random, number, &model);
        let before = model.scan(&scanning());
        let expected = mutation.apply(&mut model).unwrap();
        assert_eq!(model.revision, number + 1);
        let after = model.scan(&scanning());
        let mut sent = mutation.send(&service).await;
        if let Err(error) = &sent {
            refused += 1;
            assert_eq!(
                (error.code(), error.reason()),
                (Code::Unavailable, "STORAGE_FAILED")
            );
            let again = mutation.send(&service).await.unwrap_err();
            assert_eq!(again.code(), Code::Unavailable);
            assert_eq!(everything(&service).await, before);
            let recovering = Arc::clone(&registry);
            tokio::task::spawn_blocking(move || recovering.recover())
                .await
                .unwrap()
                .unwrap();
            let found = everything(&service).await;
            let may = [&before, &after];
            assert!(may.contains(&&found), "{found:?} is none of {may:?}");
            // A retry makes the mutation take effect once.
            sent = mutation.send(&service).await;
        }
        assert_eq!(sent.unwrap(), expected);
        assert_eq!(everything(&service).await, after);
    }
    // Two other servers start, one after an orderly end and one after a loss of power.
    drop(service);
    for end in [FaultLog::close_and_open, FaultLog::cut] {
        end(&log);
        let registry = self::registry(&log);
        registry.replay().unwrap();
        let found = everything(&serving(&registry)).await;
        assert_eq!(found, model.scan(&scanning()));
    }
    refused
}

#[tokio::test]
async fn whichever_call_of_the_log_fails_nothing_acknowledged_is_lost_and_nothing_is_half_there() {
    for seed in 0..SEEDS {
        for calls in 0..CALLS {
            println!("seed {seed}, the call after {calls} fails");
            let refused = run(seed, calls).await;
            assert!(refused == 1 || calls >= MIN_CALLS && refused == 0);
        }
    }
}
