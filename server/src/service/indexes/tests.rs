//! Names and page tokens, and an index that is found while another one is created.

use std::sync::{OnceLock, Weak};

use futures_util::FutureExt;

use super::*;
use crate::{
    log::{Catalogue, Entry, Log, LogError, MemoryLog},
    registry::RegistryOptions,
    service::{Inner, Limits},
};

#[test]
fn names() {
    let longest = "a".repeat(63);
    for name in ["a", "0", "arm-7_left", &longest] {
        assert!(is_name(name), "{name}");
    }
    let too_long = "a".repeat(64);
    for name in ["", "-a", "_a", "A", "a b", "a/b", "ä", &too_long] {
        assert!(!is_name(name), "{name}");
    }
}

#[test]
fn tokens_round_trip_and_others_are_refused() {
    let mut violations = Violations::default();
    let read = read_token(&hex::encode("arm-7"), &mut violations);
    assert_eq!(read.as_deref(), Some("arm-7"));
    assert!(violations.finish().is_ok());
    for token in ["a", "zz", "00", "ff", "é"] {
        let mut violations = Violations::default();
        assert_eq!(read_token(token, &mut violations), None);
        assert!(violations.finish().is_err(), "{token}");
    }
}

async fn create(
    service: &Service,
    name: &str,
    space: &str,
) -> Result<v1::CreateIndexResponse, Error> {
    let request = v1::CreateIndexRequest {
        name: name.into(),
        space_form: Some(SpaceForm::SpaceText(space.into())),
        ..Default::default()
    };
    service.create_index(&Call::default(), request).await
}

/// A catalogue that finds `arm` by its service while it creates another index, which no other change may overtake.
struct Overtaken {
    local: Arc<MemoryLog>,
    service: OnceLock<Weak<Inner>>,
}

impl Catalogue for Overtaken {
    fn indexes(&self) -> Result<Vec<Entry>, LogError> {
        self.local.indexes()
    }

    fn create(&self, entry: Entry) -> Result<(), LogError> {
        if let Some(inner) = self.service.get().and_then(Weak::upgrade) {
            let service = Service { inner };
            let at_once = |space| create(&service, "arm", space).now_or_never();
            let found = at_once("R1").expect("an answer without a wait").unwrap();
            assert!(!found.created);
            let other = at_once("R2").expect("an answer without a wait");
            assert_eq!(other.unwrap_err().reason(), "INDEX_EXISTS");
        }
        self.local.create(entry)
    }

    fn delete(&self, uid: Uid) -> Result<(), LogError> {
        self.local.delete(uid)
    }
}

#[tokio::test]
async fn an_index_that_exists_is_found_while_another_is_created() {
    let local = Arc::new(MemoryLog::new());
    let catalogue = Arc::new(Overtaken {
        local: Arc::clone(&local),
        service: OnceLock::new(),
    });
    let log = Log {
        catalogue: Arc::clone(&catalogue) as Arc<dyn Catalogue>,
        ..Log::from(local)
    };
    let registry = Registry::new(log, RegistryOptions::default());
    let service = Service::new(registry, Limits::default());
    service.set_ready();
    assert!(create(&service, "arm", "R1").await.unwrap().created);
    let inner = Arc::downgrade(&service.inner);
    catalogue.service.set(inner).unwrap();
    // A failed assertion of the catalogue fails the call.
    assert!(create(&service, "leg", "R1").await.unwrap().created);
}
