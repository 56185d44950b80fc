//! Above the watermarks of memory and disk the server takes in nothing that grows it, and goes on with the rest.

mod start;

use std::{
    io,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
    time::Duration,
};

use wayfold_proto::v1;
use wayfold_server::{
    log::{Log, MemoryLog},
    registry::Registry,
    service::{Code, Error, Limits, Service},
    watermark::{Resource, Usage, Watermark, WatermarkExceeded, Watermarks},
};

use crate::support::{
    snapshots::{restore, snapshot},
    *,
};

const HIGH: u64 = 85_000_000;
const LOW: u64 = 80_000_000;
const LIMIT: u64 = 100_000_000;

/// The used bytes that a watermark measures.
#[derive(Clone, Default)]
struct Used(Arc<AtomicU64>);

impl Used {
    fn set(&self, used: u64) {
        self.0.store(used, Relaxed);
    }

    fn watermark(&self, resource: Resource) -> Option<Arc<Watermark>> {
        let used = Arc::clone(&self.0);
        let level = move || {
            Ok(Usage {
                used: used.load(Relaxed),
                high: HIGH,
                low: LOW,
                limit: LIMIT,
            })
        };
        let watermark = Watermark::new(resource, level);
        Some(Arc::new(watermark.measured_every(Duration::ZERO)))
    }
}

fn watermarks(memory: &Used, disk: &Used) -> Watermarks {
    Watermarks {
        memory: memory.watermark(Resource::Memory),
        disk: disk.watermark(Resource::Disk),
    }
}

fn over(log: impl Into<Log>, watermarks: Watermarks) -> (Arc<Registry>, Service) {
    let registry = Arc::new(Registry::with_watermarks(log, options(), watermarks));
    registry.replay().unwrap();
    let service = Service::starting(Limits::default());
    service.set_registry(Arc::clone(&registry));
    service.set_ready();
    (registry, service)
}

/// Asserts that a call is refused, and returns what the refusal says.
fn full<T: std::fmt::Debug>(answer: Result<T, Error>) -> WatermarkExceeded {
    let error = answer.unwrap_err();
    assert_eq!(error.code(), Code::ResourceExhausted);
    match error {
        Error::Full { full } => full,
        other => panic!("{other}"),
    }
}

#[tokio::test]
async fn above_a_watermark_only_growth_is_refused_until_the_low_one() {
    for (resource, reason) in [
        (Resource::Memory, "MEMORY_FULL"),
        (Resource::Disk, "DISK_FULL"),
    ] {
        let (memory, disk) = (Used::default(), Used::default());
        let (_registry, service) = over(Arc::new(MemoryLog::new()), watermarks(&memory, &disk));
        let used = match resource {
            Resource::Memory => memory,
            Resource::Disk => disk,
        };
        let uid = create(&service, "arm", "R3").await;
        let first = v1::InsertRequest {
            operation_id: "first".into(),
            ..insertion(&cube(1, 20), &[])
        };
        let answer = service.insert(&CALL, first.clone()).await.unwrap();
        let session = v1::OpenSessionRequest {
            index_name: "arm".into(),
            uid: uid.clone(),
            reserve_count: 10,
            ..Default::default()
        };
        let session = service.open_session(&CALL, session.clone()).await.unwrap();
        let write = |batch, kind: v1::StepKind, id, rows: &[[f64; 3]]| v1::WriteRequest {
            index_name: "arm".into(),
            uid: uid.clone(),
            session: session.session,
            batch,
            kinds: vec![kind.into()],
            ids: vec![id],
            states: states(rows),
            ..Default::default()
        };
        let put = write(1, v1::StepKind::Put, 20, &[[0.5; 3]]);
        let written = service.write(&CALL, put.clone()).await.unwrap();

        used.set(HIGH + 1);
        let refused = service.insert(&CALL, insertion(&[[0.1; 3]], &[])).await;
        let error = refused.clone().unwrap_err();
        assert_eq!(error.reason(), reason);
        let text = error.to_string();
        assert!(text.contains(resource.setting()), "{text}");
        assert!(text.contains(&HIGH.to_string()), "{text}");
        let found = full(refused);
        assert_eq!((found.resource, found.high), (resource, HIGH));
        assert!(found.used > HIGH && found.used < HIGH + 1000, "{found:?}");
        let update = v1::UpdateRequest {
            tags: vec![7],
            ..updating(&[0])
        };
        full(service.update(&CALL, update.clone()).await);
        let second = write(2, v1::StepKind::Put, 21, &[[0.6; 3]]);
        full(service.write(&CALL, second.clone()).await);
        full(service.create_index(&CALL, creation("leg", "R3")).await);

        // Acknowledged operations keep their answers, and what changes nothing is no growth.
        assert_eq!(service.insert(&CALL, first).await.unwrap(), answer);
        assert_eq!(service.write(&CALL, put).await.unwrap(), written);
        create(&service, "arm", "R3").await;
        let same = insertion(&cube(1, 20)[..3], &[0, 1, 2]);
        service.insert(&CALL, same).await.unwrap();
        // Reads and removals go on.
        service.knn(&CALL, knn(&[[0.5; 3]], 5)).await.unwrap();
        assert_eq!(everything(&service).await.point_count, 21);
        let removed = service.remove(&CALL, removal(&[3])).await.unwrap();
        assert_eq!(removed.removed_count, 1);

        // Between the marks nothing changes.
        used.set(LOW + 1);
        full(service.insert(&CALL, insertion(&[[0.1; 3]], &[])).await);
        used.set(LOW);
        insert_rows(&service, &[[0.1; 3]], &[]).await;
        used.set(HIGH - 10_000);
        service.update(&CALL, update).await.unwrap();
        // The refused batch is the next one of its session.
        service.write(&CALL, second).await.unwrap();

        used.set(HIGH + 1);
        full(service.create_index(&CALL, creation("leg", "R3")).await);
        delete(&service, "arm").await;
    }
}

/// The answers of many such operations would grow the memory without bound.
#[tokio::test]
async fn above_a_watermark_no_answer_is_remembered_that_is_not_small() {
    let (memory, disk) = (Used::default(), Used::default());
    let (_registry, service) = over(Arc::new(MemoryLog::new()), watermarks(&memory, &disk));
    create(&service, "arm", "R3").await;
    let rows = cube(1, 200);
    service.insert(&CALL, insertion(&rows, &[])).await.unwrap();
    let same = |operation: &str, k| v1::InsertRequest {
        operation_id: operation.into(),
        neighbor_spec: Some(v1::NeighborSpec {
            k_form: Some(v1::neighbor_spec::KForm::K(k)),
            ..Default::default()
        }),
        ..insertion(&rows[..1], &[0])
    };
    memory.set(HIGH + 1);
    full(service.insert(&CALL, same("large", 100)).await);
    service.insert(&CALL, same("small", 5)).await.unwrap();
    let removal = v1::RemoveRequest {
        operation_id: "removal".into(),
        ..removal(&(100..200).collect::<Vec<u64>>())
    };
    let removed = service.remove(&CALL, removal).await.unwrap();
    assert_eq!(removed.removed_count, 100);
    memory.set(LOW);
    service.insert(&CALL, same("large", 100)).await.unwrap();
}

/// A large mutation that would cross the watermark does not close it for small ones.
#[tokio::test]
async fn a_mutation_is_refused_by_its_own_size() {
    let (memory, disk) = (Used::default(), Used::default());
    let (_registry, service) = over(Arc::new(MemoryLog::new()), watermarks(&memory, &disk));
    create(&service, "arm", "R3").await;
    memory.set(HIGH - 20_000);
    full(service.insert(&CALL, insertion(&cube(1, 1000), &[])).await);
    insert_rows(&service, &cube(1, 10), &[]).await;
}

/// The writer sessions of a snapshot count like its points.
#[tokio::test]
async fn a_restore_is_refused_by_the_size_of_its_sessions() {
    let (source, _) = arm("R1").await;
    for _ in 0..40 {
        let request = v1::OpenSessionRequest {
            index_name: "arm".into(),
            reserve_count: 2,
            ..Default::default()
        };
        source.open_session(&CALL, request).await.unwrap();
    }
    let parts = snapshot(&source, "arm").await;
    let (memory, disk) = (Used::default(), Used::default());
    let (_registry, service) = over(Arc::new(MemoryLog::new()), watermarks(&memory, &disk));
    memory.set(HIGH - 5_000);
    full(restore(&service, "leg", &parts).await);
    memory.set(HIGH - 100_000);
    restore(&service, "leg", &parts).await.unwrap();
}

/// A writer could open sessions, or take ids one by one, until a start has no memory for them.
#[tokio::test]
async fn above_a_watermark_few_sessions_open_and_reserve_few_blocks_of_ids() {
    let (memory, disk) = (Used::default(), Used::default());
    let (_registry, service) = over(Arc::new(MemoryLog::new()), watermarks(&memory, &disk));
    let uid = create(&service, "arm", "R3").await;
    let insert = insertion(&cube(1, 3), &[]);
    service.insert(&CALL, insert).await.unwrap();
    let opening = v1::OpenSessionRequest {
        index_name: "arm".into(),
        ..Default::default()
    };
    let open = || service.open_session(&CALL, opening.clone());
    let write = |session, batch, reserve_count, removed: &[u64]| v1::WriteRequest {
        index_name: "arm".into(),
        uid: uid.clone(),
        session,
        batch,
        reserve_count,
        kinds: vec![v1::StepKind::Remove.into(); removed.len()],
        ids: removed.into(),
        ..Default::default()
    };
    memory.set(HIGH + 1);
    let sessions = [open().await, open().await].map(|opened| opened.unwrap().session);
    for _ in 2..256 {
        open().await.unwrap();
    }
    full(open().await);
    // The blocks of sessions that take ids in turns do not join.
    for batch in 1..=512 {
        for session in sessions {
            let reservation = write(session, batch, 1, &[]);
            service.write(&CALL, reservation).await.unwrap();
        }
    }
    let session = sessions[0];
    full(service.write(&CALL, write(session, 513, 1, &[])).await);
    // No point has this id, so nothing is freed.
    let missing = write(session, 513, 1, &[u64::MAX >> 2]);
    full(service.write(&CALL, missing).await);
    for (batch, reserve_count, id) in [(513, 0, 1), (514, 5, 2)] {
        let removal = write(session, batch, reserve_count, &[id]);
        let written = service.write(&CALL, removal).await.unwrap();
        let reserved = written.reserved.unwrap().id_count;
        assert_eq!((written.missing_count, reserved), (0, reserve_count));
    }
    memory.set(LOW);
    let reservation = write(session, 515, 1, &[]);
    service.write(&CALL, reservation).await.unwrap();
    open().await.unwrap();
}

/// Bytes that were taken in since the last measurement count.
#[test]
fn bytes_taken_in_count_before_they_are_measured() {
    let used = Used::default();
    let watermark = used.watermark(Resource::Memory).unwrap();
    let watermark = Arc::into_inner(watermark).unwrap();
    let watermark = watermark.measured_every(Duration::MAX);
    used.set(HIGH - 600_000);
    watermark.admit(400_000).unwrap();
    assert_eq!(watermark.admit(400_000).unwrap_err().used, HIGH + 200_000);
    watermark.admit(200_000).unwrap();
    watermark.admit(1).unwrap_err();
}

#[test]
fn a_resource_that_cannot_be_measured_refuses_nothing() {
    let watermark = Watermark::new(Resource::Disk, || Err(io::ErrorKind::Unsupported.into()));
    watermark.admit(u64::MAX).unwrap();
    watermark.fits_at_start(u64::MAX).unwrap();
    assert_eq!(watermark.remaining(), None);
}
