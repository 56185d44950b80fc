//! A start with little memory loads what fits, and the rest once there is room.

use std::{
    sync::{Arc, Mutex, Weak},
    thread::{self, JoinHandle},
};

use wayfold_proto::v1;
use wayfold_server::{
    log::{Catalogue, Entry, Log, LogError, MemoryLog, Uid},
    registry::{Registry, RegistryError},
    service::{Code, Error, Limits},
};

use super::{HIGH, LIMIT, LOW, Used, over, watermarks};
use crate::support::*;

/// The memory that a start may use.
const START: u64 = HIGH + (LIMIT - HIGH) / 2;

#[tokio::test]
async fn a_start_without_memory_lists_and_deletes_and_loads_the_rest_later() {
    let log = Arc::new(MemoryLog::new());
    let before = service_with(Arc::clone(&log), Limits::default());
    for name in ["arm", "empty", "leg"] {
        create(&before, name, "R3").await;
    }
    for name in ["arm", "leg"] {
        let insert = v1::InsertRequest {
            index_name: name.into(),
            ..insertion(&cube(1, 100), &[])
        };
        before.insert(&CALL, insert).await.unwrap();
    }
    let answer = before.knn(&CALL, knn(&[[0.5; 3]], 9)).await.unwrap();
    drop(before);

    let (memory, disk) = (Used::default(), Used::default());
    memory.set(START - 1000);
    let (registry, service) = over(log, watermarks(&memory, &disk));
    let listing = service
        .list_indexes(&CALL, v1::ListIndexesRequest::default())
        .await
        .unwrap();
    let names: Vec<_> = listing.indexes.iter().map(|index| &index.name).collect();
    assert_eq!(names, ["empty"]);
    let unloaded: Vec<_> = listing.damaged.iter().map(|index| &index.name).collect();
    assert_eq!(unloaded, ["arm", "leg"]);
    for error in [
        listing.damaged[0].error.clone(),
        service.knn(&CALL, knn(&[[0.5; 3]], 9)).await.unwrap_err(),
        service.remove(&CALL, removal(&[3])).await.unwrap_err(),
    ] {
        assert_eq!(
            (error.code(), error.reason()),
            (Code::Unavailable, "NOT_LOADED")
        );
        assert!(
            matches!(error, Error::NotLoaded { points: 100, needed, .. } if needed > 2400),
            "{error}"
        );
    }
    delete(&service, "leg").await;
    registry.load_rest();
    service
        .knn(&CALL, knn(&[[0.5; 3]], 9))
        .await
        .expect_err("there is no memory yet");

    memory.set(LOW / 2);
    registry.load_rest();
    assert_eq!(
        service.knn(&CALL, knn(&[[0.5; 3]], 9)).await.unwrap(),
        answer
    );
    let error = service.get_index(
        &CALL,
        v1::GetIndexRequest {
            index_name: "leg".into(),
        },
    );
    assert_eq!(error.await.unwrap_err().code(), Code::NotFound);
}

/// A catalogue in which a deletion of an index begins while the indices are listed. It waits for the lock of changes.
struct Shrinking {
    local: Arc<MemoryLog>,
    /// The registry and the name of the index, for one deletion.
    deletion: Mutex<Option<(Weak<Registry>, &'static str)>>,
    deleting: Mutex<Option<JoinHandle<()>>>,
}

impl Catalogue for Shrinking {
    fn indexes(&self) -> Result<Vec<Entry>, LogError> {
        let entries = self.local.indexes();
        let deletion = self.deletion.lock().unwrap().take();
        if let Some((registry, name)) = deletion {
            let deleting = thread::spawn(move || {
                registry.upgrade().unwrap().delete(name, None).unwrap();
            });
            *self.deleting.lock().unwrap() = Some(deleting);
        }
        entries
    }

    fn create(&self, entry: Entry) -> Result<(), LogError> {
        self.local.create(entry)
    }

    fn delete(&self, uid: Uid) -> Result<(), LogError> {
        self.local.delete(uid)
    }
}

#[tokio::test]
async fn an_index_that_is_deleted_while_others_are_loaded_stays_deleted() {
    let local = Arc::new(MemoryLog::new());
    let before = service_with(Arc::clone(&local), Limits::default());
    for name in ["arm", "leg"] {
        create(&before, name, "R3").await;
        let insert = v1::InsertRequest {
            index_name: name.into(),
            ..insertion(&cube(1, 100), &[])
        };
        before.insert(&CALL, insert).await.unwrap();
    }
    drop(before);

    let (memory, disk) = (Used::default(), Used::default());
    memory.set(START - 1000);
    let catalogue = Arc::new(Shrinking {
        local: Arc::clone(&local),
        deletion: Mutex::default(),
        deleting: Mutex::default(),
    });
    let log = Log {
        catalogue: Arc::clone(&catalogue) as Arc<dyn Catalogue>,
        ..Log::from(local)
    };
    let (registry, service) = over(log, watermarks(&memory, &disk));
    memory.set(LOW / 2);
    *catalogue.deletion.lock().unwrap() = Some((Arc::downgrade(&registry), "leg"));
    registry.load_rest();
    let deleting = catalogue.deleting.lock().unwrap().take();
    deleting.unwrap().join().unwrap();
    service.knn(&CALL, knn(&[[0.5; 3]], 9)).await.unwrap();
    assert!(matches!(registry.get("leg"), Err(RegistryError::Deleted)));
}

/// Near the watermark the points of an index go into the forest in parts, and nothing is merged that does not fit.
#[tokio::test]
async fn an_index_that_just_fits_is_loaded_in_parts() {
    let log = Arc::new(MemoryLog::new());
    let before = service_with(Arc::clone(&log), Limits::default());
    create(&before, "arm", "R3").await;
    let rows = cube(1, 70_000);
    before.insert(&CALL, insertion(&rows, &[])).await.unwrap();
    let ask = knn(&rows[..20], 9);
    let answer = before.knn(&CALL, ask.clone()).await.unwrap();
    drop(before);

    let point_bytes = 56;
    for (free, is_loaded) in [(100_000 * point_bytes, true), (60_000 * point_bytes, false)] {
        let (memory, disk) = (Used::default(), Used::default());
        memory.set(START - free);
        let (_registry, service) = over(Arc::clone(&log), watermarks(&memory, &disk));
        match service.knn(&CALL, ask.clone()).await {
            Ok(found) => assert!(is_loaded && found == answer),
            Err(error) => assert!(!is_loaded && error.reason() == "NOT_LOADED", "{error}"),
        }
    }
}
