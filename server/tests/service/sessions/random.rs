//! Random plain calls run alone, or beside sessions that write batches. Each answer, read and mutation of the feed equals
//! the model's. Batches are retried, scans are paused, and the server restarts meanwhile.

use std::{collections::BTreeMap, mem};

use rand::RngExt;
use wayfold_index::Space;
use wayfold_proto::v1::{self, StepKind};
use wayfold_server::service::{Code, Error, Limits, Scan, Service};

use super::{Opened, batch, model::SessionModel, open, refused_batch};
use crate::{
    model::{Model, Point},
    random::{Mutation, Requests, assert_same, compare, refused},
    store::{End, Store},
    support::*,
};

/// Plain calls name ids below this, so they name none that a session reserved.
const FIRST_RESERVED: u64 = 64;

/// A session, with its newest batch.
struct Writer {
    opened: Opened,
    newest: Option<(v1::WriteRequest, v1::WriteResponse)>,
}

impl Writer {
    fn newest(&self) -> u64 {
        self.newest.as_ref().map_or(0, |(request, _)| request.batch)
    }
}

/// The content of the model at each revision.
type History = Vec<Entry>;

/// A revision: the points after it, and the session and the number of the batch that made it.
#[derive(Default)]
struct Entry {
    points: BTreeMap<u64, Point>,
    session: u64,
    batch: u64,
}

fn next_batch(requests: &mut Requests, model: &SessionModel, writer: &Writer) -> v1::WriteRequest {
    let count = requests.random.random_range(0..12);
    let reserved: Vec<u64> = model.owners.keys().copied().collect();
    let own: Vec<u64> = reserved
        .iter()
        .copied()
        .filter(|id| model.owners[id] == writer.opened.id)
        .collect();
    let (mut kinds, mut ids) = (Vec::new(), Vec::new());
    for _ in 0..count {
        let among = match requests.random.random_range(0..30) {
            0 => &reserved,
            1..=12 => &own,
            _ => &Vec::new(),
        };
        // Few ids, so that a batch names the same one again.
        ids.push(match among.len() {
            0 => requests.random.random_range(0..12),
            some => among[requests.random.random_range(0..some)],
        });
        kinds.push(requests.random.random_range(1..=5));
    }
    let count_of = |counted: &[StepKind]| {
        let kinds = kinds
            .iter()
            .filter_map(|&kind| StepKind::try_from(kind).ok());
        kinds.filter(|kind| counted.contains(kind)).count()
    };
    let puts = count_of(&[StepKind::Put, StepKind::Replace]);
    let payloads = puts + count_of(&[StepKind::SetPayload]);
    let tagged = requests.random.random_bool(0.7);
    let loaded = requests.random.random_bool(0.5);
    v1::WriteRequest {
        kinds,
        tags: if tagged {
            requests.tags(count)
        } else {
            Vec::new()
        },
        payloads: if loaded {
            requests.payloads(payloads)
        } else {
            Vec::new()
        },
        states: requests.states(puts as u32),
        ids,
        reserve_count: requests.random.random_range(0..3),
        ..batch(&writer.opened, writer.newest() + 1, &[])
    }
}

/// Compares the feed with the history: each revision once, with the points that changed and no others. The feed of a
/// session differs in its own batches only, which come without points and removed ids.
async fn compare_feed(service: &Service, uid: &str, history: &History, writers: &[Writer]) {
    let mutations = feed(service, uid, history, 0).await;
    for own_session in writers.iter().map(|writer| writer.opened.id) {
        let mut expected = mutations.clone();
        for own in expected.iter_mut().filter(|it| it.session == own_session) {
            (own.stored, own.removed_ids) = (None, Vec::new());
        }
        assert_eq!(feed(service, uid, history, own_session).await, expected);
    }
    let mut points = BTreeMap::new();
    for (fed, mutation) in (1..).zip(mutations) {
        assert!(!mutation.continued);
        assert_eq!(mutation.revision, revision(uid, fed as u64));
        for id in &mutation.removed_ids {
            assert!(points.remove(id).is_some(), "{id} is not stored");
        }
        let stored = mutation.stored.unwrap_or_default();
        let rows = stored.states.unwrap_or_default().coordinates;
        let width = rows.len() / stored.ids.len().max(1);
        for (at, &id) in stored.ids.iter().enumerate() {
            assert!(!mutation.removed_ids.contains(&id));
            let point = Point {
                row: rows[at * width..][..width].to_vec(),
                tag: stored.tags[at],
                payload: stored.payloads[at].clone(),
                stored: stored.revisions[at],
                modified: fed as u64,
            };
            points.insert(id, point);
        }
        // A point that is fed without a change has the wrong `modified`.
        let expected = &history[fed];
        assert_eq!(points, expected.points, "revision {fed}");
        let made_by = (expected.session, expected.batch);
        assert_eq!(
            (mutation.session, mutation.batch),
            made_by,
            "revision {fed}"
        );
    }
}

/// All mutations of the history, as the server feeds them to a session.
async fn feed(
    service: &Service,
    uid: &str,
    history: &History,
    own_session: u64,
) -> Vec<v1::Mutation> {
    let mut mutations = Vec::new();
    while mutations.len() + 1 < history.len() {
        let request = v1::WatchRequest {
            own_session,
            ..watching(uid, mutations.len() as u64)
        };
        mutations.extend(service.log(&CALL, request).await.unwrap().mutations);
    }
    mutations
}

/// Finishes a scan that began when the index had the content of `expected`.
async fn finish((mut scan, expected): (Scan, v1::ScanResponse)) {
    assert_same(scan.next().await.unwrap(), Ok(expected), "a scan");
    assert!(scan.next().await.is_none());
}

async fn run(space: &str, seed: u64, sessions: bool, mut store: Store) {
    // Former services may still have their stores open.
    let mut former = Vec::new();
    let mut service = restarted(store.open());
    let uid = create(&service, "arm", space).await;
    let space: Space = space.parse().unwrap();
    let mut requests = Requests::new(seed, &space, &uid);
    let mut model = SessionModel {
        model: Model::new(space, uid.clone()),
        owners: BTreeMap::new(),
        idle_seconds: Limits::default().max_session_idle_seconds,
    };
    let mut history: History = vec![Entry::default()];
    if sessions {
        let first = Mutation::Insert(v1::InsertRequest {
            index_name: "arm".into(),
            states: requests.states(1),
            ids: vec![FIRST_RESERVED - 1],
            ..Default::default()
        });
        let answer = refused(first.send(&service).await);
        assert_eq!(answer, first.apply(&mut model.model));
        history.push(Entry {
            points: model.model.points.clone(),
            ..Entry::default()
        });
    }
    let mut writers: Vec<Writer> = Vec::new();
    let mut scans = Vec::new();
    // The kinds of steps below 11 need sessions, so a run without them takes fewer steps.
    let (first_kind, steps) = if sessions { (0, 110) } else { (11, 66) };
    for _ in 0..steps {
        let revision = model.model.revision;
        let mut made_by = (0, 0);
        let at = requests.random.random_range(0..writers.len().max(1));
        match requests.random.random_range(first_kind..22) {
            0 => {
                let reserve_count = requests.random.random_range(0..5);
                let (opened, response) = open(&service, &uid, reserve_count).await;
                assert_eq!(response, model.open(reserve_count));
                writers.push(Writer {
                    opened,
                    newest: None,
                });
            }
            1..=8 if !writers.is_empty() => {
                let request = next_batch(&mut requests, &model, &writers[at]);
                let answer = service.write(&CALL, request.clone()).await;
                match (answer, model.write(&request)) {
                    (Ok(response), Ok(expected)) => {
                        assert_eq!(response, expected, "{request:?}");
                        made_by = (request.session, request.batch);
                        writers[at].newest = Some((request, response));
                    }
                    (Err(Error::IdsReserved { mut ids, .. }), Err(expected)) => {
                        ids.sort_unstable();
                        assert_eq!(ids, expected, "{request:?}");
                    }
                    (answer, expected) => panic!("{answer:?}, {expected:?}: {request:?}"),
                }
            }
            9 | 10 if !writers.is_empty() => {
                if let Some((request, response)) = &writers[at].newest {
                    let retry = service.write(&CALL, request.clone()).await;
                    assert_eq!(retry.unwrap(), *response);
                    let other = v1::WriteRequest {
                        reserve_count: request.reserve_count + 1,
                        ..request.clone()
                    };
                    let mismatch = (Code::InvalidArgument, "BATCH_MISMATCH");
                    assert_eq!(refused_batch(&service, other).await, mismatch);
                }
                let newest = writers[at].newest();
                for number in [0, newest.saturating_sub(1), newest + 2, u64::MAX] {
                    if number == newest && number > 0 {
                        continue;
                    }
                    let refused =
                        refused_batch(&service, batch(&writers[at].opened, number, &[])).await;
                    assert_eq!(refused, (Code::FailedPrecondition, "BATCH_OUT_OF_ORDER"));
                }
            }
            11..=18 => {
                let mutation = requests.mutation(revision, String::new());
                let answer = refused(mutation.send(&service).await);
                assert_eq!(answer, mutation.apply(&mut model.model), "{mutation:?}");
            }
            19 => {
                let request = requests.scan(revision);
                let scan = service.scan(&CALL, request.clone()).await.unwrap();
                scans.push((scan, model.model.scan(&request)));
            }
            20 if !scans.is_empty() => {
                let at = requests.random.random_range(0..scans.len());
                finish(scans.swap_remove(at)).await;
            }
            21 if requests.random.random_bool(0.3) => {
                for scan in scans.drain(..) {
                    finish(scan).await;
                }
                if let Some(left) = store.left(End::Crash) {
                    former.push(mem::replace(&mut store, left));
                }
                service = restarted(store.open());
            }
            _ => {}
        }
        if model.model.revision > revision {
            let (session, batch) = made_by;
            let points = model.model.points.clone();
            history.push(Entry {
                points,
                session,
                batch,
            });
        }
        compare(&service, &model.model, &mut requests).await;
    }
    for scan in scans {
        finish(scan).await;
    }
    assert_same(
        Ok(everything(&service).await),
        Ok(model.model.scan(&scanning())),
        "a scan",
    );
    compare_feed(&service, &uid, &history, &writers).await;
}

async fn run_all(spaces: &[&str], seeds: u64, sessions: bool, store: fn() -> Store) {
    for space in spaces {
        for seed in 0..seeds {
            // The output is shown only if the test fails.
            println!("space {space}, seed {seed}");
            run(space, seed, sessions, store()).await;
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_answer_is_the_models() {
    let spaces = ["R1", "SO2[1]", "R2*SO2", "R3*SO3:0.15", "sum(R2, SO3)"];
    run_all(&spaces, 40, false, Store::in_memory).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_answer_to_a_session_is_the_models() {
    let spaces = ["R1", "R2*SO2", "sum(R2, SO3)"];
    run_all(&spaces, 40, true, Store::in_memory).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_answer_is_the_models_on_a_disk_too() {
    run_all(&["R2*SO2"], 4, true, Store::on_disk).await;
}
