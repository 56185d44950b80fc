//! Snapshots and their parts, for the tests that take and restore them.

use bytes::Bytes;
use wayfold_proto::snapshot::{Content, Header, Reader};

use super::*;
use crate::random::Requests;

/// The content of a snapshot, with the revision in which each point was last changed.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct SnapshotContent {
    pub(crate) header: Header,
    pub(crate) ids: Vec<u64>,
    pub(crate) points: Vec<(u64, u64, u64, Vec<f64>, Bytes)>,
    pub(crate) sessions: v1::SnapshotSessions,
}

pub(crate) async fn snapshot(service: &Service, name: &str) -> Vec<v1::SnapshotPart> {
    let request = v1::SnapshotIndexRequest {
        index_name: name.into(),
        min_revision: None,
    };
    let mut snapshot = service.snapshot_index(&CALL, request).await.unwrap();
    let mut parts = Vec::new();
    while let Some(part) = snapshot.next().await {
        parts.push(part.unwrap().part.unwrap());
    }
    parts
}

/// Reads the parts of a sound snapshot.
pub(crate) fn read(parts: &[v1::SnapshotPart]) -> SnapshotContent {
    let mut reader = Reader::new();
    let (mut header, mut ids, mut all) = (None, Vec::new(), Vec::new());
    let mut sessions = v1::SnapshotSessions::default();
    for part in parts {
        match reader.read(part).unwrap() {
            Content::Header(found) => header = Some(found),
            Content::Points(points, modified) => {
                let rows = points.states.unwrap().coordinates;
                let width = rows.len() / points.ids.len();
                for (at, row) in rows.chunks(width).enumerate() {
                    let payload = points.payloads.get(at).cloned().unwrap_or_default();
                    ids.push(points.ids[at]);
                    let revisions = (points.tags[at], points.revisions[at], modified[at]);
                    all.push((revisions.0, revisions.1, revisions.2, row.to_vec(), payload));
                }
            }
            Content::Sessions(page) => {
                sessions.sessions.extend(page.sessions);
                sessions.blocks.extend(page.blocks);
            }
            Content::Trailer => {}
        }
    }
    reader.finish().unwrap();
    SnapshotContent {
        header: header.unwrap(),
        ids,
        points: all,
        sessions,
    }
}

pub(crate) async fn restore(
    service: &Service,
    name: &str,
    parts: &[v1::SnapshotPart],
) -> Result<v1::Index, Error> {
    let mut restoring = service.restore_index(&CALL)?;
    for (at, part) in parts.iter().enumerate() {
        let name = if at == 0 { name.into() } else { String::new() };
        let part = Some(part.clone());
        let message = v1::RestoreIndexRequest { name, part };
        restoring.add(message).await?;
    }
    Ok(restoring.finish().await?.index.unwrap())
}

pub(crate) fn verification() -> v1::VerifyIndexRequest {
    v1::VerifyIndexRequest {
        index_name: "arm".into(),
        ..Default::default()
    }
}

pub(crate) async fn verify(
    service: &Service,
    request: v1::VerifyIndexRequest,
) -> Result<v1::VerifyReport, Error> {
    use v1::verify_index_response::Result::{Progress, Report};
    let mut verification = service.verify_index(&CALL, request).await?;
    let mut last = 0;
    loop {
        let answer = verification.next().await.unwrap()?;
        match answer.result.unwrap() {
            Progress(progress) => {
                assert!(last <= progress.read_point_count);
                assert!(progress.read_point_count <= progress.total_point_count);
                last = progress.read_point_count;
            }
            Report(report) => {
                assert!(verification.next().await.is_none());
                return Ok(report);
            }
        }
    }
}

/// The answer of `GetIndex` without the memory: merging changes the memory at any time.
pub(crate) async fn described(service: &Service, name: &str) -> v1::Index {
    settled(info(service, name).await)
}

pub(crate) fn settled(index: v1::Index) -> v1::Index {
    v1::Index {
        memory_bytes: 0,
        ..index
    }
}

/// An index `arm` with a history: replaced, removed and tagged points, payloads, gaps, and ids that were used and
/// freed.
pub(crate) async fn lived_in(service: &Service, space: &str, seed: u64) -> String {
    let uid = create(service, "arm", space).await;
    let parsed: Space = space.parse().unwrap();
    let mut requests = Requests::new(seed, &parsed, &uid);
    for round in 0..60 {
        let revision = info(service, "arm").await.revision;
        // Refused mutations are part of the history too.
        match round % 4 {
            0 | 1 => drop(
                service
                    .insert(&CALL, requests.insert(revision.number()))
                    .await,
            ),
            2 => drop(
                service
                    .update(&CALL, requests.update(revision.number()))
                    .await,
            ),
            _ => drop(service.remove(&CALL, requests.remove()).await),
        }
    }
    uid
}

/// A service over this log.
pub(crate) fn over(log: impl Into<wayfold_server::log::Log>) -> Service {
    service_with(log, wayfold_server::service::Limits::default())
}
