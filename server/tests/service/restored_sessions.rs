//! A restored index goes on with the writer sessions of the other: batches, their responses, reserved ids, idle time.

use std::sync::Arc;

use wayfold_proto::{
    snapshot::{Header, Writer},
    v1::{self, StepKind},
};
use wayfold_server::{
    log::{Durability, FjallLog, Log, MemoryLog},
    service::{Code, Limits, Service},
};

use crate::{
    copied::copied,
    support::{snapshots::*, *},
};

async fn open(service: &Service, reserve_count: u64) -> v1::OpenSessionResponse {
    let request = v1::OpenSessionRequest {
        index_name: "arm".into(),
        reserve_count,
        ..Default::default()
    };
    service.open_session(&CALL, request).await.unwrap()
}

/// The batch of a session that puts this id and reserves three more.
fn batch(session: u64, batch: u64, id: u64) -> v1::WriteRequest {
    v1::WriteRequest {
        session,
        batch,
        kinds: vec![StepKind::Put.into(), StepKind::Remove.into()],
        ids: vec![id, 500],
        states: states(&[[0.25]]),
        reserve_count: 3,
        ..Default::default()
    }
}

/// Writes a batch to the index of this name.
async fn write(
    service: &Service,
    name: &str,
    request: v1::WriteRequest,
) -> Result<v1::WriteResponse, wayfold_server::service::Error> {
    let request = v1::WriteRequest {
        index_name: name.into(),
        uid: info(service, name).await.revision.uid(),
        ..request
    };
    service.write(&CALL, request).await
}

/// Inserts one row under this id, or under an assigned one.
fn insert(name: &str, id: Option<u64>) -> v1::InsertRequest {
    v1::InsertRequest {
        index_name: name.into(),
        ids: id.into_iter().collect(),
        ..insertion(&[[0.75]], &[])
    }
}

/// An index with two sessions of 10 ids each, of which the first wrote batch 1; returns the response.
async fn two_sessions() -> (Service, v1::WriteResponse) {
    let (service, _) = arm("R1").await;
    assert_eq!(open(&service, 10).await.session, 1);
    assert_eq!(open(&service, 10).await.session, 2);
    let response = write(&service, "arm", batch(1, 1, 4)).await.unwrap();
    let reserved = response.reserved.unwrap();
    assert_eq!((reserved.first_id, reserved.id_count), (20, 3));
    (service, response)
}

/// Asserts that the restored index `leg` goes on where [`two_sessions`] ended.
async fn check_goes_on(service: &Service, response: &v1::WriteResponse) {
    let uid = info(service, "leg").await.revision.uid();
    assert_ne!(uid, response.revision.uid());
    // A retry gets the recorded response, with the revision of the first uid.
    for _ in 0..2 {
        let retried = write(service, "leg", batch(1, 1, 4)).await;
        assert_eq!(retried.unwrap(), *response);
    }
    assert_eq!(info(service, "leg").await.revision.number(), 3);
    let other = refusal(write(service, "leg", batch(1, 1, 5)).await);
    assert_eq!(other.0, Code::InvalidArgument);
    let skipped = refusal(write(service, "leg", batch(1, 3, 5)).await);
    assert_eq!(skipped.0, Code::FailedPrecondition);

    // Reserved ids stay reserved, and assigned ones are above them.
    for id in [0, 9, 10, 19, 20, 22] {
        let reserved = refusal(service.insert(&CALL, insert("leg", Some(id))).await);
        assert_eq!(reserved.0, Code::AlreadyExists, "id {id}");
    }
    let foreign = refusal(write(service, "leg", batch(1, 2, 15)).await);
    assert_eq!(foreign.0, Code::AlreadyExists);
    let assigned = service.insert(&CALL, insert("leg", None)).await.unwrap();
    assert_eq!(assigned.ids, [23]);

    let next = write(service, "leg", batch(1, 2, 21)).await.unwrap();
    let reserved = next.reserved.unwrap();
    assert_eq!((reserved.first_id, reserved.id_count), (24, 3));
    assert_eq!(next.revision, revision(&uid, 5));
    let first = write(service, "leg", batch(2, 1, 15)).await.unwrap();
    assert_eq!(first.revision, revision(&uid, 6));
}

#[tokio::test]
async fn a_restored_index_goes_on_with_the_sessions() {
    let directory = tempfile::tempdir().unwrap();
    let disk = FjallLog::open(directory.path(), Durability::Fsync).unwrap();
    for log in [Log::from(Arc::new(MemoryLog::new())), Arc::new(disk).into()] {
        let (source, response) = two_sessions().await;
        let parts = snapshot(&source, "arm").await;
        let target = over(log);
        restore(&target, "leg", &parts).await.unwrap();
        let again = snapshot(&target, "leg").await;
        assert_eq!(read(&again).sessions, read(&parts).sessions);
        check_goes_on(&target, &response).await;
    }
    // The store on disk holds them after a crash too.
    let (source, response) = two_sessions().await;
    let parts = snapshot(&source, "arm").await;
    let directory = tempfile::tempdir().unwrap();
    let disk = FjallLog::open(directory.path(), Durability::Fsync).unwrap();
    let target = over(Arc::new(disk));
    restore(&target, "leg", &parts).await.unwrap();
    let crashed = copied(directory.path());
    let log = FjallLog::open(crashed.path(), Durability::Fsync).unwrap();
    check_goes_on(&restarted(Arc::new(log)), &response).await;
}

#[tokio::test]
async fn many_sessions_take_several_parts() {
    let limits = Limits {
        max_answer_bytes: 2048,
        ..Limits::default()
    };
    let (service, _) = arm_with("R1", limits).await;
    let mut expected = v1::SnapshotSessions::default();
    for at in 0..40 {
        let session = open(&service, 2).await.session;
        let block = v1::SnapshotBlock {
            first_id: 2 * at,
            id_count: 2,
            session,
        };
        expected.blocks.push(block);
    }
    let parts = snapshot(&service, "arm").await;
    // Header, sessions, blocks, trailer.
    assert!(parts.len() > 5, "{} parts", parts.len());
    let sessions = read(&parts).sessions;
    let ids: Vec<u64> = sessions.sessions.iter().map(|it| it.session).collect();
    assert_eq!(ids, (1..=40).collect::<Vec<_>>());
    assert_eq!(sessions.blocks, expected.blocks);
    restore(&service, "leg", &parts).await.unwrap();
    assert_eq!(read(&snapshot(&service, "leg").await).sessions, sessions);

    // A server that may hold fewer refuses them.
    let limits = Limits {
        max_sessions: 39,
        ..Limits::default()
    };
    let small = service_with(Arc::new(MemoryLog::new()), limits);
    let refused = refusal(restore(&small, "arm", &parts).await);
    let expected = (Code::ResourceExhausted, "LIMIT_EXCEEDED");
    assert_eq!((refused.0, refused.1), expected);
}

/// The idle time of a session runs from its newest revision, in a restored index too.
#[tokio::test]
async fn an_idle_session_of_a_snapshot_ends_when_another_is_opened() {
    let header = Header {
        name: "arm".into(),
        uid: String::new(),
        space: "R1".parse().unwrap(),
        revision: 1,
        next_id: 10,
        point_count: 0,
        payload_encoding: Default::default(),
    };
    let session = v1::SnapshotSession {
        session: 1,
        batch: 6,
        fingerprint: vec![0; 32],
        response: Vec::new(),
        time_ms: 0,
    };
    let block = v1::SnapshotBlock {
        first_id: 0,
        id_count: 10,
        session: 1,
    };
    let sessions = v1::SnapshotSessions {
        sessions: vec![session],
        blocks: vec![block],
    };
    let mut writer = Writer::new();
    let parts = [
        writer.header(&header),
        writer.sessions(sessions),
        writer.trailer(),
    ];
    let service = service();
    restore(&service, "arm", &parts).await.unwrap();
    write(&service, "arm", batch(1, 7, 4)).await.unwrap();

    restore(&service, "leg", &parts).await.unwrap();
    let request = v1::OpenSessionRequest {
        index_name: "leg".into(),
        ..Default::default()
    };
    service.open_session(&CALL, request).await.unwrap();
    let ended = refusal(write(&service, "leg", batch(1, 7, 4)).await);
    assert_eq!(ended.0, Code::FailedPrecondition);
    let kept = read(&snapshot(&service, "leg").await);
    let ids: Vec<u64> = kept.sessions.sessions.iter().map(|it| it.session).collect();
    assert_eq!((ids, kept.sessions.blocks), (vec![2], Vec::new()));
    assert_eq!(kept.header.next_id, 10);
}
