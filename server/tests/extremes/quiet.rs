//! Calls that wait, in the process of the test, and must not spin.

use std::{
    future::poll_fn,
    pin::pin,
    sync::Arc,
    time::{Duration, Instant},
};

use wayfold_proto::v1::{self, create_index_request::SpaceForm};
use wayfold_server::{
    log::MemoryLog,
    registry::{Registry, RegistryOptions},
    service::{Call, Limits, Service},
};

/// The maximum number of polls of a call about two points; a call that spins exceeds it.
const MAX_POLLS: usize = 300;

/// `arm` with two points and a writer session, each made by a revision, and its uid.
pub(crate) async fn two_points() -> (Service, String) {
    let registry = Registry::new(Arc::new(MemoryLog::new()), RegistryOptions::default());
    let (service, call) = (Service::new(registry, Limits::default()), Call::default());
    service.set_ready();
    let create = v1::CreateIndexRequest {
        name: "arm".into(),
        space_form: Some(SpaceForm::SpaceText("R1".into())),
        ..Default::default()
    };
    let created = service.create_index(&call, create).await.unwrap();
    for id in 0..2 {
        let insert = v1::InsertRequest {
            index_name: "arm".into(),
            states: Some(v1::States {
                row_count: 1,
                coordinates: vec![id as f64],
            }),
            ids: vec![id],
            tags: vec![1],
            ..Default::default()
        };
        service.insert(&call, insert).await.unwrap();
    }
    let session = v1::OpenSessionRequest {
        index_name: "arm".into(),
        ..Default::default()
    };
    service.open_session(&call, session).await.unwrap();
    (service, created.index.unwrap().revision.unwrap().uid)
}

/// A deadline in a minute of the paused clock, which each wait moves ahead of the real one.
pub(crate) fn deadline() -> Instant {
    (tokio::time::Instant::now() + Duration::from_secs(60)).into_std()
}

/// Awaits a call and asserts that it does not spin.
pub(crate) async fn quietly<T>(call: impl Future<Output = T>) -> T {
    let mut call = pin!(call);
    let mut polls = 0;
    poll_fn(|context| {
        polls += 1;
        assert!(polls <= MAX_POLLS, "a call spins");
        call.as_mut().poll(context)
    })
    .await
}
