//! The disk fails under a running service and comes back: writes are refused, reads go on, and no mutation is half
//! applied.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

use wayfold_proto::v1;
use wayfold_server::{
    log::{Durability, FjallLog},
    registry::{Registry, RegistryError},
    service::{Call, Code, Limits, Service},
};

use crate::{
    copied::copied,
    journal_end::newest_journal,
    support::*,
    tables::{flip, in_tables, move_to_tables, payload, places},
};

/// A service over a store whose directory can be removed.
struct Failing {
    service: Service,
    registry: Arc<Registry>,
    store: PathBuf,
    away: PathBuf,
    directory: tempfile::TempDir,
}

impl Failing {
    fn new() -> Self {
        Self::at(tempfile::tempdir().unwrap())
    }

    /// Starts a service over the directory that another service left.
    fn at(directory: tempfile::TempDir) -> Self {
        let log = FjallLog::open(directory.path(), Durability::Fsync).unwrap();
        let registry = Arc::new(Registry::new(Arc::new(log), options()));
        registry.replay().unwrap();
        let service = Service::starting(Limits::default());
        service.set_registry(Arc::clone(&registry));
        service.set_ready();
        Self {
            service,
            registry,
            store: directory.path().join("store"),
            away: directory.path().join("away"),
            directory,
        }
    }

    fn fail(&self) {
        std::fs::rename(&self.store, &self.away).unwrap();
    }

    fn mend(&self) {
        std::fs::rename(&self.away, &self.store).unwrap();
    }

    /// Flips a bit of a payload that is in tables.
    fn damage_payload(&self, payload: &[u8]) {
        let (table, at) = places(self.directory.path(), payload).swap_remove(0);
        flip(&table, at);
    }

    async fn recover(&self) -> Result<(), RegistryError> {
        let registry = Arc::clone(&self.registry);
        tokio::task::spawn_blocking(move || registry.recover())
            .await
            .unwrap()
    }
}

fn operation(id: u64) -> v1::InsertRequest {
    v1::InsertRequest {
        operation_id: format!("op {id}"),
        payloads: vec![format!("payload {id}").into_bytes().into()],
        ..insertion(&[[id as f64]], &[id])
    }
}

fn unavailable<T: std::fmt::Debug>(answer: Result<T, wayfold_server::service::Error>) {
    let error = answer.unwrap_err();
    assert_eq!(
        (error.code(), error.reason()),
        (Code::Unavailable, "STORAGE_FAILED"),
        "{error}"
    );
}

#[tokio::test]
async fn a_failed_disk_refuses_writes_and_serves_reads_until_it_recovers() {
    let failing = Failing::new();
    let service = &failing.service;
    let uid = create(service, "arm", "R1").await;
    let idle = create(service, "idle", "R1").await;
    for id in 0..20 {
        service.insert(&CALL, operation(id)).await.unwrap();
    }
    for (round, id) in (20..23).enumerate() {
        let before = everything(service).await;
        failing.fail();
        // The insert was under way during the failure, so its outcome is unknown.
        unavailable(service.insert(&CALL, operation(id)).await);
        // This call was refused before anything was written.
        unavailable(service.insert(&CALL, operation(99)).await);
        // Another server of a cluster learns that nothing was.
        let forwarded = Call {
            is_forwarded: true,
            ..Call::default()
        };
        let refused = service.insert(&forwarded, operation(99)).await.unwrap_err();
        assert_eq!(refused.reason(), "INDEX_NOT_FOUND");
        unavailable(service.create_index(&CALL, creation("new", "R1")).await);
        let delete = v1::DeleteIndexRequest {
            index_name: "idle".into(),
            ..Default::default()
        };
        unavailable(service.delete_index(&CALL, delete).await);
        assert_eq!(everything(service).await, before);
        assert_eq!(
            service
                .knn(&CALL, knn(&[[3.1]], 2))
                .await
                .unwrap()
                .neighbors
                .unwrap()
                .ids,
            [3, 4]
        );
        failing.recover().await.unwrap_err();
        assert_eq!(everything(service).await, before);

        failing.mend();
        failing.recover().await.unwrap();
        failing.recover().await.unwrap();
        assert_eq!(
            (
                info(service, "arm").await.revision.uid(),
                info(service, "idle").await.revision.uid()
            ),
            (uid.clone(), idle.clone())
        );
        // The retry takes effect exactly once, after either outcome.
        let revision = service
            .insert(&CALL, operation(id))
            .await
            .unwrap()
            .revision
            .number();
        assert_eq!(revision, 21 + round as u64);
        let after = everything(service).await;
        assert_eq!(
            (after.revision.number(), after.point_count),
            (revision, id + 1)
        );
        assert_eq!(after.points.unwrap().ids, (0..=id).collect::<Vec<_>>());
    }
    let found = service.get(&CALL, getting(&[7, 22])).await.unwrap();
    assert_eq!(found.points.unwrap().payloads, ["payload 7", "payload 22"]);
}

#[tokio::test]
async fn reads_across_the_end_of_a_failure_are_unavailable() {
    let failing = Failing::new();
    let service = &failing.service;
    create(service, "arm", "R1").await;
    for id in 0..5 {
        service.insert(&CALL, operation(id)).await.unwrap();
    }
    let mut scan = service.scan(&CALL, scanning()).await.unwrap();
    failing.fail();
    unavailable(service.insert(&CALL, operation(5)).await);
    failing.mend();
    failing.recover().await.unwrap();
    unavailable(scan.next().await.unwrap());
    assert_eq!(everything(service).await.point_count, 6);
}

/// Flips a bit in the middle of the newest journal file of a store.
fn damage(store: &Path) {
    let (journal, used) = newest_journal(store);
    let mut bytes = std::fs::read(&journal).unwrap();
    bytes[used as usize / 2] ^= 1;
    std::fs::write(&journal, bytes).unwrap();
}

/// A failed store turns out to be damaged when the service reopens it. The service reports it as a start would, without
/// a restart.
#[tokio::test]
async fn damage_that_is_found_on_the_way_is_named_for_every_call() {
    let failing = Failing::new();
    let service = &failing.service;
    create(service, "arm", "R1").await;
    for id in 0..20 {
        service.insert(&CALL, operation(id)).await.unwrap();
    }
    failing.fail();
    unavailable(service.insert(&CALL, operation(20)).await);
    failing.mend();
    damage(&failing.store);
    failing.recover().await.unwrap_err();
    let insert = service.insert(&CALL, operation(21)).await;
    let knn = service.knn(&CALL, knn(&[[3.1]], 2)).await;
    let create = service.create_index(&CALL, creation("new", "R1")).await;
    for code in [refusal(insert).0, refusal(knn).0, refusal(create).0] {
        assert_eq!(code, Code::DataLoss);
    }
    let listed = service.list_indexes(&CALL, v1::ListIndexesRequest::default());
    let listed = listed.await.unwrap();
    assert_eq!((listed.indexes.len(), &*listed.damaged[0].name), (0, "arm"));
}

/// The service finds a damaged block of a table when it reopens the store. The content of the block is lost, and the
/// rest stays writable.
#[tokio::test]
async fn damage_found_during_a_reopening_costs_only_the_damaged_content() {
    let directory = tempfile::tempdir().unwrap();
    let log = FjallLog::open(directory.path(), Durability::Fsync).unwrap();
    let service = service_with(Arc::new(log), Limits::default());
    for name in ["arm", "base"] {
        create(&service, name, "R1").await;
    }
    // Each payload fills blocks of its own; the first block leads to them.
    for id in 1..4 {
        let mut insert = insertion(&[[1.0]], &[id]);
        insert.payloads = vec![payload(id, 20_000)];
        service.insert(&CALL, insert).await.unwrap();
    }
    drop(service);
    move_to_tables(directory.path());

    let failing = Failing::at(directory);
    let service = &failing.service;
    let base = |id: u64| v1::InsertRequest {
        index_name: "base".into(),
        ..operation(id)
    };
    service.insert(&CALL, base(1)).await.unwrap();
    failing.fail();
    unavailable(service.insert(&CALL, base(2)).await);
    failing.mend();
    failing.damage_payload(&payload(3, 20_000));
    failing.recover().await.unwrap();
    assert_eq!(
        refusal(service.knn(&CALL, knn(&[[3.1]], 2)).await).0,
        Code::DataLoss
    );
    assert_eq!(
        refusal(service.insert(&CALL, operation(3)).await).0,
        Code::DataLoss
    );
    let inserted = service.insert(&CALL, base(3)).await.unwrap();
    assert_eq!(info(service, "base").await.revision, inserted.revision);
}

/// Below fsync no mark names the indices. A missing store must still not be served as an empty one.
#[tokio::test]
async fn a_store_that_cannot_be_opened_is_not_served_as_an_empty_one() {
    let directory = tempfile::tempdir().unwrap();
    let log = FjallLog::open(directory.path(), Durability::Os).unwrap();
    let service = service_with(Arc::new(log), Limits::default());
    create(&service, "arm", "R1").await;
    for id in 0..20 {
        service.insert(&CALL, operation(id)).await.unwrap();
    }
    let crashed = copied(directory.path());
    damage(&crashed.path().join("store"));
    for missing in [false, true] {
        if missing {
            std::fs::remove_dir_all(crashed.path().join("store")).unwrap();
        }
        let log = FjallLog::open(crashed.path(), Durability::Os).unwrap();
        let service = restarted(Arc::new(log));
        let listed = service
            .list_indexes(&CALL, v1::ListIndexesRequest::default())
            .await;
        assert_eq!(listed.err().unwrap().code(), Code::DataLoss);
        assert_eq!(
            refusal(service.knn(&CALL, knn(&[[3.1]], 2)).await).0,
            Code::DataLoss
        );
        let create = service.create_index(&CALL, creation("arm", "R1")).await;
        assert_eq!(refusal(create).0, Code::DataLoss);
    }
}

/// fjall stops writing for good when it has to rewrite a damaged block. Reads go on, and each write fails with an
/// instruction for the operator.
#[tokio::test]
async fn a_store_that_meets_damage_while_it_is_written_is_read_and_asks_for_a_repair() {
    const POINT_BYTES: usize = 32 * 1024;
    const MAX_INSERTS: u64 = 500;
    let insert = |ids: &[u64]| v1::InsertRequest {
        index_name: "base".into(),
        payloads: ids.iter().map(|id| payload(*id, POINT_BYTES)).collect(),
        ..insertion(&vec![[0.5]; ids.len()], ids)
    };
    let directory = tempfile::tempdir().unwrap();
    in_tables(directory.path(), "base", &[], POINT_BYTES);
    // fjall rewrites these tables with the next one or two.
    let tables = [1..=10, 11..=15, 16..=20];
    in_tables(directory.path(), "arm", &tables, POINT_BYTES);
    let failing = Failing::at(directory);
    let service = &failing.service;
    failing.damage_payload(&payload(10, POINT_BYTES));
    let mut inserted = 0;
    let refused = loop {
        assert!(inserted < MAX_INSERTS, "the block was never rewritten");
        let ids: Vec<u64> = (inserted * 32..(inserted + 1) * 32).collect();
        match service.insert(&CALL, insert(&ids)).await {
            Ok(_) => inserted += 1,
            Err(refused) => break Err::<(), _>(refused),
        }
    };
    unavailable(refused);
    for _ in 0..2 {
        let why = failing.recover().await.unwrap_err().to_string();
        assert!(why.contains("`wayfold-server repair`"), "{why}");
        let refused = service.insert(&CALL, insert(&[MAX_INSERTS * 32])).await;
        let refused = refused.unwrap_err();
        assert_eq!(refused.code(), Code::Unavailable);
        assert!(refused.to_string().contains("`wayfold-server repair`"));
        let get = v1::GetRequest {
            index_name: "base".into(),
            ..getting(&[7])
        };
        let points = service.get(&CALL, get).await.unwrap().points.unwrap();
        assert_eq!(points.payloads, [payload(7, POINT_BYTES)]);
    }
}
