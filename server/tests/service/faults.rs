//! Any call of the log may fail. Afterwards an acknowledged mutation is stored, a refused one is stored whole or not at
//! all, and reads go on.

use std::{collections::BTreeMap, sync::Arc};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold_proto::v1;
use wayfold_server::{
    registry::{Registry, RegistryOptions},
    service::{Code, Error, Limits, Service},
};

use crate::{fault::FaultLog, support::*};

const SEEDS: u64 = 4;
const MUTATIONS: u64 = 25;
/// Calls that fail, one in each run. Every mutation makes two at least.
const CALLS: u64 = 60;
/// Every run makes at least this many of these calls.
const MIN_CALLS: u64 = 30;

/// State, tag, payload.
type Point = ([f64; 2], u64, String);

#[derive(Clone, Debug)]
enum Mutation {
    Insert(v1::InsertRequest),
    Update(v1::UpdateRequest),
    Remove(v1::RemoveRequest),
}

impl Mutation {
    fn draw(random: &mut ChaCha8Rng, number: u64, points: &BTreeMap<u64, Point>) -> Self {
        let operation_id = format!("op {number}");
        let mut some = |ids: Vec<u64>, most: usize| {
            let mut drawn: Vec<u64> = (0..most)
                .map(|_| ids[random.random_range(0..ids.len())])
                .collect();
            drawn.sort_unstable();
            drawn.dedup();
            drawn
        };
        let present: Vec<u64> = points.keys().copied().collect();
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

    fn apply(&self, points: &mut BTreeMap<u64, Point>) {
        let text = |payload: &[u8]| String::from_utf8(payload.to_vec()).unwrap();
        match self {
            Mutation::Insert(request) => {
                let rows = &request.states.as_ref().unwrap().coordinates;
                for (i, row) in rows.as_chunks::<2>().0.iter().enumerate() {
                    let point = (*row, request.tags[i], text(&request.payloads[i]));
                    points.insert(request.ids[i], point);
                }
            }
            Mutation::Update(request) => {
                for (id, payload) in request.ids.iter().zip(&request.payloads) {
                    let point = points.get_mut(id).unwrap();
                    (point.1, point.2) = (request.tags[0], text(payload));
                }
            }
            Mutation::Remove(request) => points.retain(|id, _| !request.ids.contains(id)),
        }
    }

    /// The revision that the mutation made.
    async fn send(&self, service: &Service) -> Result<u64, Error> {
        Ok(match self.clone() {
            Mutation::Insert(request) => service.insert(&CALL, request).await?.revision.number(),
            Mutation::Update(request) => service.update(&CALL, request).await?.revision.number(),
            Mutation::Remove(request) => service.remove(&CALL, request).await?.revision.number(),
        })
    }
}

/// The readable content of `arm`, and its revision.
async fn read(service: &Service) -> (u64, BTreeMap<u64, Point>) {
    let part = everything(service).await;
    let points = part.points.unwrap_or_default();
    let rows = points.states.unwrap_or_default().coordinates;
    let rows = rows.as_chunks::<2>().0.iter();
    let content = rows.zip(&points.tags).zip(&points.payloads);
    let content = content.map(|((row, tag), payload)| {
        let payload = String::from_utf8(payload.to_vec()).unwrap();
        (*row, *tag, payload)
    });
    (
        part.revision.number(),
        points.ids.into_iter().zip(content).collect(),
    )
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
    let (mut revision, mut points, mut refused) = (0, BTreeMap::new(), 0);
    log.fail_after(calls);
    for number in 0..MUTATIONS {
        let mutation = Mutation::draw(&mut random, number, &points);
        let before = points.clone();
        mutation.apply(&mut points);
        let sent = mutation.send(&service).await;
        if let Err(error) = &sent {
            refused += 1;
            assert_eq!(
                (error.code(), error.reason()),
                (Code::Unavailable, "STORAGE_FAILED")
            );
            let again = mutation.send(&service).await.unwrap_err();
            assert_eq!(again.code(), Code::Unavailable);
            assert_eq!(read(&service).await, (revision, before.clone()));
            let recovering = Arc::clone(&registry);
            tokio::task::spawn_blocking(move || recovering.recover())
                .await
                .unwrap()
                .unwrap();
            let found = read(&service).await;
            let may = [(revision, before), (revision + 1, points.clone())];
            assert!(may.contains(&found), "{found:?} is none of {may:?}");
            // A retry makes the mutation take effect once.
            assert_eq!(mutation.send(&service).await.unwrap(), revision + 1);
        }
        revision += 1;
        assert_eq!(sent.unwrap_or(revision), revision);
        assert_eq!(read(&service).await, (revision, points.clone()));
        assert_eq!(info(&service, "arm").await.revision.uid(), uid);
    }
    // Two other servers start, one after an orderly end and one after a loss of power.
    drop(service);
    for end in [FaultLog::close_and_open, FaultLog::cut] {
        end(&log);
        let registry = self::registry(&log);
        registry.replay().unwrap();
        assert_eq!(read(&serving(&registry)).await, (revision, points.clone()));
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
