//! Services to test, and short constructors of requests.

use std::sync::{Arc, LazyLock};

use wayfold_index::Space;
use wayfold_proto::v1::{
    self,
    neighbor_spec::{KForm, RadiusForm},
};
use wayfold_server::{
    log::{Log, MemoryLog},
    registry::{Registry, RegistryOptions},
    service::{Call, Code, Error, Limits, Service},
};

pub(crate) mod snapshots;

/// No deadline.
pub(crate) static CALL: LazyLock<Call> = LazyLock::new(Call::default);

/// Trees and leaves are small, so that a few dozen points reach every branch of the code.
pub(crate) fn options() -> RegistryOptions {
    RegistryOptions {
        growing_rows: Some(4),
        leaf_rows: Some(2),
        ..RegistryOptions::default()
    }
}

pub(crate) fn service() -> Service {
    service_with(Arc::new(MemoryLog::new()), Limits::default())
}

pub(crate) fn service_with(log: impl Into<Log>, limits: Limits) -> Service {
    let options = RegistryOptions {
        operations: limits.operations(),
        ..options()
    };
    let service = Service::new(Registry::new(log, options), limits);
    service.set_ready();
    service
}

/// A service over a log that an earlier service may have written.
pub(crate) fn restarted(log: impl Into<Log>) -> Service {
    restarted_with(log, options(), Limits::default())
}

pub(crate) fn restarted_with(
    log: impl Into<Log>,
    options: RegistryOptions,
    limits: Limits,
) -> Service {
    let options = RegistryOptions {
        operations: limits.operations(),
        ..options
    };
    let registry = Registry::new(log, options);
    registry.replay().unwrap();
    let service = Service::new(registry, limits);
    service.set_ready();
    service
}

/// A service with one index, `arm`, and that index's uid.
pub(crate) async fn arm(space: &str) -> (Service, String) {
    arm_with(space, Limits::default()).await
}

pub(crate) async fn arm_with(space: &str, limits: Limits) -> (Service, String) {
    let service = service_with(Arc::new(MemoryLog::new()), limits);
    let uid = create(&service, "arm", space).await;
    (service, uid)
}

pub(crate) async fn create(service: &Service, name: &str, space: &str) -> String {
    let created = service.create_index(&CALL, creation(name, space)).await;
    created.unwrap().index.unwrap().revision.uid()
}

pub(crate) async fn delete(service: &Service, name: &str) {
    let request = v1::DeleteIndexRequest {
        index_name: name.into(),
        ..Default::default()
    };
    service.delete_index(&CALL, request).await.unwrap();
}

pub(crate) fn creation(name: &str, space: &str) -> v1::CreateIndexRequest {
    v1::CreateIndexRequest {
        name: name.into(),
        space_form: Some(v1::create_index_request::SpaceForm::SpaceText(space.into())),
        ..Default::default()
    }
}

/// A creation that declares edges in the payloads.
pub(crate) fn creation_with_edges(name: &str, space: &str) -> v1::CreateIndexRequest {
    v1::CreateIndexRequest {
        payload_encoding: v1::PayloadEncoding::Edges.into(),
        ..creation(name, space)
    }
}

pub(crate) async fn info(service: &Service, name: &str) -> v1::Index {
    let request = v1::GetIndexRequest {
        index_name: name.into(),
    };
    service
        .get_index(&CALL, request)
        .await
        .unwrap()
        .index
        .unwrap()
}

pub(crate) fn states<const N: usize>(rows: &[[f64; N]]) -> Option<v1::States> {
    Some(v1::States {
        row_count: rows.len() as u32,
        coordinates: rows.concat(),
    })
}

/// Rows into `arm`; an empty `ids` lets the server assign them.
pub(crate) fn insertion<const N: usize>(rows: &[[f64; N]], ids: &[u64]) -> v1::InsertRequest {
    v1::InsertRequest {
        index_name: "arm".into(),
        states: states(rows),
        ids: ids.into(),
        ..Default::default()
    }
}

pub(crate) async fn insert_rows<const N: usize>(
    service: &Service,
    rows: &[[f64; N]],
    ids: &[u64],
) -> v1::InsertResponse {
    let inserted = service.insert(&CALL, insertion(rows, ids)).await;
    inserted.unwrap()
}

/// `rows` random states of R3 in [0, 1)^3, the same for the same seed.
pub(crate) fn cube(seed: u64, rows: usize) -> Vec<[f64; 3]> {
    use rand::{RngExt, SeedableRng};
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    (0..rows).map(|_| random.random()).collect()
}

pub(crate) fn updating(ids: &[u64]) -> v1::UpdateRequest {
    v1::UpdateRequest {
        index_name: "arm".into(),
        ids: ids.into(),
        ..Default::default()
    }
}

pub(crate) fn removal(ids: &[u64]) -> v1::RemoveRequest {
    v1::RemoveRequest {
        index_name: "arm".into(),
        ids: ids.into(),
        ..Default::default()
    }
}

pub(crate) fn knn<const N: usize>(rows: &[[f64; N]], k: u32) -> v1::KnnRequest {
    v1::KnnRequest {
        index_name: "arm".into(),
        states: states(rows),
        k_form: nearest(k).map(Into::into),
        ..Default::default()
    }
}

pub(crate) fn getting(ids: &[u64]) -> v1::GetRequest {
    v1::GetRequest {
        index_name: "arm".into(),
        ids: ids.into(),
        include: ALL,
        min_revision: None,
        latest: false,
    }
}

pub(crate) fn scanning() -> v1::ScanRequest {
    v1::ScanRequest {
        index_name: "arm".into(),
        include: ALL,
        ..Default::default()
    }
}

/// Asks for the mutations of `arm` after a revision.
pub(crate) fn watching(uid: &str, after_revision: u64) -> v1::WatchRequest {
    v1::WatchRequest {
        index_name: "arm".into(),
        after_revision: revision(uid, after_revision),
        include: ALL,
        own_session: 0,
    }
}

/// Everything in `arm`, as one part.
pub(crate) async fn everything(service: &Service) -> v1::ScanResponse {
    let mut scan = service.scan(&CALL, scanning()).await.unwrap();
    let part = scan.next().await.unwrap().unwrap();
    assert!(scan.next().await.is_none());
    part
}

pub(crate) fn canonical(space: &Space, rows: &[f64]) -> Vec<f64> {
    let mut rows = rows.to_vec();
    for row in rows.chunks_exact_mut(space.coordinates()) {
        space.canonicalize(row).unwrap();
    }
    rows
}

/// The code, the reason, and the first field of a failed call.
pub(crate) fn refusal<T: std::fmt::Debug>(
    result: Result<T, Error>,
) -> (Code, &'static str, String) {
    let error = result.unwrap_err();
    let field = match &error {
        Error::InvalidArgument { violations } => violations[0].field.clone(),
        _ => String::new(),
    };
    (error.code(), error.reason(), field)
}

/// All columns.
pub(crate) const ALL: Option<v1::Include> = Some(v1::Include {
    with_states: true,
    with_tags: true,
    with_revisions: true,
    with_payloads: true,
});

/// This many neighbours.
pub(crate) fn nearest(k: u32) -> Option<KForm> {
    Some(KForm::K(k))
}

/// All neighbours at this distance or nearer.
pub(crate) fn within<R: From<RadiusForm>>(radius: f64) -> Option<R> {
    Some(RadiusForm::Radius(radius).into())
}

/// A revision of the index that has this uid.
pub(crate) fn revision(uid: &str, number: u64) -> Option<v1::Revision> {
    let uid = uid.into();
    Some(v1::Revision { uid, number })
}

/// The parts of the revision that an answer names.
pub(crate) trait RevisionParts {
    fn number(&self) -> u64;
    fn uid(&self) -> String;
}

impl RevisionParts for Option<v1::Revision> {
    fn number(&self) -> u64 {
        self.as_ref().expect("a revision").number
    }

    fn uid(&self) -> String {
        self.as_ref().expect("a revision").uid.clone()
    }
}

/// Advances the paused clock by this much; the timers that are due meanwhile fire in their order.
pub(crate) async fn pass(time: std::time::Duration) {
    let _ = tokio::time::timeout(time, std::future::pending::<()>()).await;
}
