//! Names and page tokens, an index that is found while another one is created, and creates that are cancelled.

use std::{
    sync::{OnceLock, Weak},
    time::Duration,
};

use futures_util::{FutureExt, poll};
use tokio::{
    runtime::{Builder, Handle},
    task::unconstrained,
    time::timeout,
};
use tokio_util::sync::CancellationToken;

use super::*;
use crate::{
    admission::MAX_CHANGES,
    log::{Catalogue, Entry, Log, LogError, MemoryLog, PointStore, View},
    registry::{Registry, RegistryOptions},
    service::{ClientPermits, Inner, Limits, stored},
    testing::{arm, log_with},
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
    create_by(&Call::default(), service, name, space).await
}

async fn create_by(
    call: &Call,
    service: &Service,
    name: &str,
    space: &str,
) -> Result<v1::CreateIndexResponse, Error> {
    let request = v1::CreateIndexRequest {
        name: name.into(),
        space_form: Some(SpaceForm::SpaceText(space.into())),
        ..Default::default()
    };
    service.create_index(call, request).await
}

/// A catalogue that calls `before_create` before it creates an index, and that has not heard of what other servers made.
struct Hooked<F> {
    local: Arc<MemoryLog>,
    before_create: F,
}

impl<F: Fn() + Send + Sync> Catalogue for Hooked<F> {
    fn indexes(&self) -> Result<Vec<Entry>, LogError> {
        self.local.indexes()
    }

    fn create(&self, entry: Entry) -> Result<(), LogError> {
        (self.before_create)();
        self.local.create(entry)
    }

    fn delete(&self, uid: Uid) -> Result<(), LogError> {
        self.local.delete(uid)
    }

    fn is_past(&self, _: &str, _: &str, _: Option<Uid>) -> bool {
        false
    }
}

/// A service over a log with such a catalogue.
fn service_hooked(
    local: &Arc<MemoryLog>,
    before_create: impl Fn() + Send + Sync + 'static,
) -> Service {
    let log = Log {
        catalogue: Arc::new(Hooked {
            local: Arc::clone(local),
            before_create,
        }),
        ..Log::from(Arc::clone(local))
    };
    let registry = Registry::new(log, RegistryOptions::default());
    let service = Service::new(registry, Limits::default());
    service.set_ready();
    service
}

#[tokio::test]
async fn a_server_that_is_behind_does_not_judge_a_uid() {
    let service = service_hooked(&Arc::new(MemoryLog::new()), || ());
    create(&service, "arm", "R1").await.unwrap();
    let call = Call::default();
    for index_name in ["arm", "leg"].map(String::from) {
        let uid = Uid::unique().to_string();
        let revision = v1::Revision {
            uid: uid.clone(),
            number: 1,
        };
        let delete = v1::DeleteIndexRequest {
            index_name: index_name.clone(),
            uid: uid.clone(),
        };
        let get = v1::GetRequest {
            index_name: index_name.clone(),
            min_revision: Some(revision.clone()),
            ..Default::default()
        };
        let scan = v1::ScanRequest {
            index_name: index_name.clone(),
            min_revision: Some(revision.clone()),
            ..Default::default()
        };
        let watch = v1::WatchRequest {
            index_name: index_name.clone(),
            after_revision: Some(revision),
            ..Default::default()
        };
        let write = v1::WriteRequest {
            index_name,
            uid,
            ..Default::default()
        };
        for refused in [
            service.delete_index(&call, delete).await.map(drop),
            service.get(&call, get).await.map(drop),
            service.scan(&call, scan).await.map(drop),
            service.watch(&call, watch).await.map(drop),
            service.write(&call, write).await.map(drop),
        ] {
            assert_eq!(refused.unwrap_err().reason(), "UID_UNKNOWN");
        }
    }
}

/// The server that forwarded the call has another index of the name, and evaluates it there.
#[tokio::test]
async fn a_forwarded_mutation_of_an_index_that_is_unknown_here_is_refused() {
    let service = service_hooked(&Arc::new(MemoryLog::new()), || ());
    create(&service, "arm", "R1").await.unwrap();
    let uid = service.registry().unwrap().get("arm").unwrap().uid();
    for (uid, refusal) in [(uid, None), (Uid::unique(), Some("UID_UNKNOWN"))] {
        let call = Call {
            is_forwarded: true,
            forwarded_uid: Some(uid),
            ..Call::default()
        };
        let removal = v1::RemoveRequest {
            index_name: "arm".into(),
            ids: vec![7],
            ..Default::default()
        };
        let removed = service.remove(&call, removal).await;
        assert_eq!(removed.err().map(|error| error.reason()), refusal);
    }
}

#[tokio::test]
async fn an_index_that_exists_is_found_while_another_is_created() {
    let known = Arc::new(OnceLock::<Weak<Inner>>::new());
    let weak = Arc::clone(&known);
    // The hook finds `arm` by its service while another index is created, which no other change may overtake.
    let service = service_hooked(&Arc::new(MemoryLog::new()), move || {
        if let Some(inner) = weak.get().and_then(Weak::upgrade) {
            let service = Service { inner };
            let at_once = |space| create(&service, "arm", space).now_or_never();
            let found = at_once("R1").expect("an answer without a wait").unwrap();
            assert!(!found.created);
            let other = at_once("R2").expect("an answer without a wait");
            assert_eq!(other.unwrap_err().reason(), "INDEX_EXISTS");
        }
    });
    assert!(create(&service, "arm", "R1").await.unwrap().created);
    known.set(Arc::downgrade(&service.inner)).unwrap();
    // A failed assertion of the catalogue fails the call.
    assert!(create(&service, "leg", "R1").await.unwrap().created);
}

/// A service whose creates wait for the gate, and its log.
fn slow() -> (Service, Arc<MemoryLog>, CancellationToken) {
    let (local, gate) = (Arc::new(MemoryLog::new()), CancellationToken::new());
    let opened = gate.clone();
    let wait = move || Handle::current().block_on(opened.cancelled());
    (service_hooked(&local, wait), local, gate)
}

#[test]
fn cancelled_creates_leave_a_thread_to_reads() {
    let mut runtime = Builder::new_current_thread();
    let runtime = runtime.enable_all().max_blocking_threads(MAX_CHANGES + 1);
    runtime.build().unwrap().block_on(async {
        let (service, local, gate) = slow();
        let names: Vec<_> = (0..4 * MAX_CHANGES).map(|at| format!("arm-{at}")).collect();
        let creates = names.iter().map(|name| create(&service, name, "R1"));
        let mut creates: Vec<_> = creates.map(|it| Box::pin(unconstrained(it))).collect();
        for create in &mut creates {
            assert!(poll!(create).is_pending());
        }
        drop(creates);
        let entry = arm();
        let view: Arc<dyn View> = log_with(&entry, &[]).view(entry.uid).unwrap();
        let call = Call::default();
        let read = stored::read_copy(&call, "reading", "arm", (&view, false), |_| Ok(()));
        let read = timeout(Duration::from_secs(10), read).await;
        // Threads that wait would keep a failed test from its end.
        gate.cancel();
        read.expect("creates have all threads").unwrap();
        assert!(create(&service, "leg", "R1").await.unwrap().created);
        let created = local.indexes().unwrap().len();
        assert!(created <= MAX_CHANGES + 1, "{created} indices");
    });
}

#[tokio::test]
async fn the_creates_of_a_client_wait_among_themselves() {
    let (service, _, gate) = slow();
    let [many, one] = [(); 2].map(|()| Call {
        permits: Some(Arc::new(ClientPermits::new(1))),
        ..Call::default()
    });
    let names: Vec<_> = (0..2 * MAX_CHANGES).map(|at| format!("arm-{at}")).collect();
    let creates = names
        .iter()
        .map(|name| create_by(&many, &service, name, "R1"));
    let mut creates: Vec<_> = creates.map(|it| Box::pin(unconstrained(it))).collect();
    for create in &mut creates {
        assert!(poll!(create).is_pending());
    }
    let free = service.inner.changes.available_permits();
    assert_eq!(free, MAX_CHANGES - MAX_CHANGES / 4);
    let mut last = Box::pin(create_by(&one, &service, "leg", "R1"));
    assert!(poll!(&mut last).is_pending());
    assert_eq!(service.inner.changes.available_permits(), free - 1);
    gate.cancel();
    last.await.unwrap();
    for create in creates {
        create.await.unwrap();
    }
}
