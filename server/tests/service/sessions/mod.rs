//! Writer sessions: each batch takes effect once, whatever happens between a call and its retry.

mod expiry;
mod feed;
mod ids;
mod model;
mod random;
mod refusals;
mod retries;
mod shared_journal;

use wayfold_proto::v1::{self, StepKind};
use wayfold_server::service::{Code, Error, Service};

use crate::support::*;

/// An open session.
#[derive(Clone, Debug)]
struct Opened {
    uid: String,
    id: u64,
    /// The first reserved id.
    first: u64,
}

/// A step of a batch on an index of R1.
#[derive(Clone, Copy)]
enum Step {
    Put(u64, f64),
    Remove(u64),
    Tag(u64, u64),
}

use Step::{Put, Remove, Tag};

async fn open(
    service: &Service,
    uid: &str,
    reserve_count: u64,
) -> (Opened, v1::OpenSessionResponse) {
    let response = service.open_session(&CALL, opening(reserve_count)).await;
    let response = response.unwrap();
    let opened = Opened {
        uid: uid.into(),
        id: response.session,
        first: response.reserved.unwrap().first_id,
    };
    (opened, response)
}

fn opening(reserve_count: u64) -> v1::OpenSessionRequest {
    v1::OpenSessionRequest {
        index_name: "arm".into(),
        reserve_count,
        ..Default::default()
    }
}

/// A batch of the session. A put has the tag 0.
fn batch(session: &Opened, number: u64, steps: &[Step]) -> v1::WriteRequest {
    let mut request = v1::WriteRequest {
        index_name: "arm".into(),
        uid: session.uid.clone(),
        session: session.id,
        batch: number,
        ..Default::default()
    };
    let mut rows = Vec::new();
    for step in steps {
        let (kind, id, tag) = match *step {
            Put(id, row) => {
                rows.push([row]);
                (StepKind::Put, id, 0)
            }
            Remove(id) => (StepKind::Remove, id, 0),
            Tag(id, tag) => (StepKind::SetTag, id, tag),
        };
        request.kinds.push(kind.into());
        request.ids.push(id);
        request.tags.push(tag);
    }
    request.states = states(&rows);
    request
}

async fn write(service: &Service, request: v1::WriteRequest) -> v1::WriteResponse {
    service.write(&CALL, request).await.unwrap()
}

/// The code and the reason of a batch that fails.
async fn refused_batch(service: &Service, request: v1::WriteRequest) -> (Code, &'static str) {
    let (code, reason, _) = refusal(service.write(&CALL, request).await);
    (code, reason)
}

/// The ids of all points.
async fn stored(service: &Service) -> Vec<u64> {
    everything(service).await.points.unwrap().ids
}
