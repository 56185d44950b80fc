//! Writer sessions in the script: handwritten operations, and their JSON.

use serde_json::{Value, json};
use wayfold_proto::v1::{self, StepKind};

use super::{
    json::{integer, integers, object, payloads, read_integer, read_revision, states},
    op::Op,
    outcome::UID,
    target::Answer,
};

/// Operations on the index "arm" at revision 1, where the highest id is 50.
pub(crate) fn by_hand() -> Vec<Op> {
    let open = |reserve_count| {
        Op::OpenSession(v1::OpenSessionRequest {
            index_name: "arm".into(),
            uid: UID.into(),
            reserve_count,
            operation_id: "open".into(),
        })
    };
    let first = v1::WriteRequest {
        index_name: "arm".into(),
        uid: UID.into(),
        // The revision that opened the session.
        session: 2,
        batch: 1,
        kinds: [StepKind::Put, StepKind::SetTag, StepKind::Remove]
            .map(Into::into)
            .into(),
        ids: vec![51, 50, 9],
        states: Some(v1::States {
            row_count: 1,
            coordinates: vec![0.1, 0.2, 0.3, 0.6, 0.8],
        }),
        tags: vec![u64::MAX, 3, 0],
        payloads: vec![vec![7; 3].into()],
        reserve_count: 2,
    };
    let write = |change: fn(&mut v1::WriteRequest)| {
        let mut request = first.clone();
        change(&mut request);
        Op::Write(request)
    };
    vec![
        open(3),
        write(|_| {}),
        write(|_| {}),
        write(|it| it.tags[1] = 4),
        write(|it| it.batch = 0),
        write(|it| it.batch = 3),
        write(|it| it.session = u64::MAX),
        write(|it| it.uid = "another".into()),
        write(|it| it.uid.clear()),
        write(|it| it.kinds[1] = 0),
        write(|it| it.kinds[2] = 9),
        write(|it| it.ids[2] = 1 << 63),
        write(|it| it.ids.truncate(2)),
        write(|it| it.states = None),
        write(|it| (it.batch, it.reserve_count) = (2, u64::MAX)),
        open(u64::MAX),
        // Another session's ids.
        open(0),
        write(|it| (it.session, it.ids[0]) = (4, 52)),
        write(|it| (it.batch, it.tags) = (2, Vec::new())),
    ]
}

pub(super) fn opening(it: &v1::OpenSessionRequest) -> Value {
    let reserve_count = integer(&it.reserve_count);
    json!({ "uid": it.uid, "reserve_count": reserve_count, "operation_id": it.operation_id })
}

pub(super) fn batch(it: &v1::WriteRequest) -> Value {
    let kind = |kind: &i32| match kind {
        1 => json!("PUT"),
        2 => json!("REMOVE"),
        3 => json!("SET_TAG"),
        4 => json!("REPLACE"),
        5 => json!("SET_PAYLOAD"),
        other => json!(other),
    };
    object([
        ("uid", Some(json!(it.uid))),
        ("session", Some(integer(&it.session))),
        ("batch", Some(integer(&it.batch))),
        ("kinds", Some(it.kinds.iter().map(kind).collect())),
        ("ids", Some(integers(&it.ids))),
        ("states", it.states.as_ref().map(states)),
        ("tags", Some(integers(&it.tags))),
        ("payloads", Some(payloads(&it.payloads))),
        ("reserve_count", Some(integer(&it.reserve_count))),
    ])
}

pub(super) fn opened(it: &Value) -> Answer {
    Answer::OpenSession(v1::OpenSessionResponse {
        session: read_integer(&it["session"]),
        reserved: Some(block(&it["reserved"])),
        idle_seconds: read_integer(&it["idle_seconds"]),
        revision: read_revision(&it["revision"]),
    })
}

pub(super) fn written(it: &Value) -> Answer {
    Answer::Write(v1::WriteResponse {
        reserved: Some(block(&it["reserved"])),
        missing_count: read_integer(&it["missing_count"]),
        revision: read_revision(&it["revision"]),
    })
}

fn block(it: &Value) -> v1::IdBlock {
    v1::IdBlock {
        first_id: read_integer(&it["first_id"]),
        id_count: read_integer(&it["id_count"]),
    }
}
