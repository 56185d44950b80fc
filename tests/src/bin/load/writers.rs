//! Inserts that request the neighbours of the inserted states, 64 at a time, without the network. They show the
//! parallelism of inserts although an index has only one writer.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use tokio::task::JoinSet;
use wayfold_proto::v1::{CreateIndexRequest, InsertRequest, create_index_request::SpaceForm};
use wayfold_server::{
    log::MemoryLog,
    registry::{Registry, RegistryOptions},
    service::{Call, Limits, Service},
};
use wayfold_tests::{States, k_nearest, row_states};

use crate::{INDEX, K, SPACE, WIDTH};

/// The number of concurrent inserts.
pub(crate) const WRITERS: usize = 64;
/// The numbers of states in one call.
pub(crate) const BATCHES: [usize; 2] = [1, 100];
/// The number of initial points, and of inserted ones.
pub(crate) const POINTS: usize = 50_000;

/// The result of one measurement.
#[derive(Clone, Copy, Debug)]
pub(crate) struct WriterRates {
    /// States inserted per second.
    pub(crate) rate: f64,
    /// The fraction of the time in which one of them held the writer.
    pub(crate) writer: f64,
    /// The average number of used processors.
    pub(crate) processors: f64,
}

/// Inserts into an index in memory, `batch` states per call. Each call requests the nearest neighbour of each state.
pub(crate) async fn write(batch: usize, round: u64) -> WriterRates {
    let registry = Registry::new(Arc::new(MemoryLog::new()), RegistryOptions::default());
    registry.replay().expect("an empty log");
    let registry = Arc::new(registry);
    let service = Service::starting(Limits::default());
    service.set_registry(Arc::clone(&registry));
    service.set_ready();
    let request = CreateIndexRequest {
        name: INDEX.into(),
        space_form: Some(SpaceForm::SpaceText(SPACE.into())),
    };
    let created = service.create_index(&Call::default(), request).await;
    created.expect("an index");
    let mut states = States::new(SPACE.parse().expect("a space"), 50 + round);
    for _ in 0..POINTS / 1_000 {
        insert(&service, &states.rows(1_000), false).await;
    }
    let of_each: Vec<_> = (0..WRITERS)
        .map(|_| states.rows(POINTS / WRITERS / batch * batch))
        .collect();
    let inserted: usize = of_each.iter().map(|rows| rows.len() / WIDTH).sum();

    let held_before = held(&registry).await;
    let (started, processor) = (Instant::now(), processor());
    let mut writers = JoinSet::new();
    for rows in of_each {
        let service = service.clone();
        writers.spawn(async move {
            for rows in rows.chunks(batch * WIDTH) {
                insert(&service, rows, true).await;
            }
        });
    }
    writers.join_all().await;
    let seconds = started.elapsed().as_secs_f64();
    WriterRates {
        rate: inserted as f64 / seconds,
        writer: (held(&registry).await - held_before).as_secs_f64() / seconds,
        processors: (self::processor() - processor) / seconds,
    }
}

async fn insert(service: &Service, rows: &[f64], with_neighbors: bool) {
    let request = InsertRequest {
        index_name: INDEX.into(),
        states: Some(row_states(rows, WIDTH)),
        neighbors: with_neighbors.then(|| k_nearest(K)),
        ..Default::default()
    };
    let inserted = service.insert(&Call::default(), request).await;
    assert_eq!(inserted.expect("an insert").ids.len(), rows.len() / WIDTH);
}

async fn held(registry: &Registry) -> Duration {
    let hosted = registry.get(INDEX).expect("the index");
    hosted.write().await.expect("its writer").held()
}

/// Processor time of this process.
fn processor() -> f64 {
    wayfold_tests::figures::processor_seconds(std::process::id()).unwrap_or(f64::NAN)
}
