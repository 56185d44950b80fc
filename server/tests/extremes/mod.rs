//! Requests with integers that no honest client sends.
//!
//! They are derived from one good request for each verb by its descriptor, so a field that is added later is tried too.

use std::sync::LazyLock;

use prost::Message;
use prost_reflect::{
    DescriptorPool, DynamicMessage, Kind, MessageDescriptor, ReflectMessage, Value,
};
use rand::{Rng, RngExt, SeedableRng, seq::IndexedRandom};
use rand_chacha::ChaCha8Rng;
use wayfold_proto::v1::{self, create_index_request::SpaceForm};

/// The values that each integer field takes.
pub(crate) const EXTREMES: [u64; 9] = [
    0,
    1,
    1 << 31,
    u32::MAX as u64,
    1 << 53,
    i64::MAX as u64,
    1 << 63,
    u64::MAX - 1,
    u64::MAX,
];

/// The number of requests of each verb that have random integers.
const RANDOM: u64 = 64;

/// The depth to which nested messages are visited, which ends the recursion: a space holds spaces.
const DEPTH: usize = 5;

/// The descriptors of `wayfold.v1`.
pub(crate) fn pool() -> DescriptorPool {
    static POOL: LazyLock<DescriptorPool> =
        LazyLock::new(|| DescriptorPool::decode(v1::FILE_DESCRIPTOR_SET).unwrap());
    POOL.clone()
}

/// A good request for each verb but `RestoreIndex`, by the name of its message. Its index is `arm` in R1, which has this
/// uid, two points, two revisions, and a writer session that the third one opened.
pub(crate) fn requests(uid: &str) -> Vec<DynamicMessage> {
    let (index, uid) = ("arm".to_owned(), uid.to_owned());
    let states = Some(v1::States {
        row_count: 1,
        coordinates: vec![0.25],
    });
    let revision = Some(v1::Revision {
        uid: uid.clone(),
        number: 1,
    });
    let filter = Some(v1::Filter {
        tag_mask: 3,
        tag_value: 1,
        since_revision: revision.clone(),
    });
    let include = Some(v1::Include {
        with_states: true,
        with_tags: true,
        with_revisions: true,
        with_payloads: true,
    });
    let knn = v1::KnnRequest {
        index_name: index.clone(),
        states: states.clone(),
        k_form: Some(v1::knn_request::KForm::K(2)),
        filter: filter.clone(),
        include,
        min_revision: revision.clone(),
        ..Default::default()
    };
    let insert = v1::InsertRequest {
        index_name: index.clone(),
        states: states.clone(),
        tags: vec![1],
        payloads: vec![b"payload".as_slice().into()],
        min_separation: 1e-300,
        neighbor_spec: Some(v1::NeighborSpec {
            k_form: Some(v1::neighbor_spec::KForm::K(2)),
            filter: filter.clone(),
            include,
            ..Default::default()
        }),
        uid: uid.clone(),
        ..Default::default()
    };
    let with_ids = v1::InsertRequest {
        ids: vec![1],
        on_conflict: v1::OnConflict::Replace.into(),
        ..insert.clone()
    };
    vec![
        dynamic("KnnRequest", &knn),
        dynamic("StreamKnnRequest", &v1::StreamKnnRequest { knn: Some(knn) }),
        dynamic(
            "QueryRequest",
            &v1::QueryRequest {
                index_name: index.clone(),
                states: states.clone(),
                radius_form: Some(v1::query_request::RadiusForm::Radius(f64::INFINITY)),
                filter: filter.clone(),
                include,
                min_revision: revision.clone(),
                ..Default::default()
            },
        ),
        dynamic("InsertRequest", &insert),
        dynamic("InsertRequest", &with_ids),
        dynamic(
            "UpdateRequest",
            &v1::UpdateRequest {
                index_name: index.clone(),
                ids: vec![1],
                tags: vec![1],
                uid: uid.clone(),
                if_revision: Some(v1::Revision {
                    uid: uid.clone(),
                    number: 2,
                }),
                ..Default::default()
            },
        ),
        dynamic(
            "OpenSessionRequest",
            &v1::OpenSessionRequest {
                index_name: index.clone(),
                uid: uid.clone(),
                reserve_count: 2,
                operation_id: "open".into(),
            },
        ),
        dynamic(
            "WriteRequest",
            &v1::WriteRequest {
                index_name: index.clone(),
                uid: uid.clone(),
                session: 3,
                batch: 1,
                kinds: vec![v1::StepKind::Put.into(), v1::StepKind::SetTag.into()],
                ids: vec![7, 0],
                states,
                tags: vec![1, 2],
                payloads: vec![b"payload".as_slice().into()],
                reserve_count: 2,
            },
        ),
        dynamic(
            "GetRequest",
            &v1::GetRequest {
                index_name: index.clone(),
                ids: vec![1],
                include,
                min_revision: revision.clone(),
                latest: false,
            },
        ),
        dynamic(
            "ScanRequest",
            &v1::ScanRequest {
                index_name: index.clone(),
                filter,
                include,
                after_id: Some(0),
                min_revision: revision.clone(),
                latest: false,
                page_size: 1,
                held_scan: String::new(),
            },
        ),
        dynamic(
            "WatchRequest",
            &v1::WatchRequest {
                index_name: index.clone(),
                after_revision: revision.clone(),
                include,
                own_session: 3,
            },
        ),
        dynamic(
            "CreateIndexRequest",
            &v1::CreateIndexRequest {
                name: "other".into(),
                space_form: Some(SpaceForm::SpaceText("R1".into())),
                ..Default::default()
            },
        ),
        dynamic(
            "CreateIndexRequest",
            &v1::CreateIndexRequest {
                name: "third".into(),
                space_form: Some(SpaceForm::Space(wayfold_proto::space::to_message(
                    &"R1".parse().unwrap(),
                ))),
                ..Default::default()
            },
        ),
        dynamic("GetServerRequest", &v1::GetServerRequest {}),
        dynamic("ListIndexesRequest", &v1::ListIndexesRequest::default()),
        dynamic(
            "GetIndexRequest",
            &v1::GetIndexRequest {
                index_name: index.clone(),
            },
        ),
        dynamic(
            "SnapshotIndexRequest",
            &v1::SnapshotIndexRequest {
                index_name: index.clone(),
                min_revision: revision.clone(),
            },
        ),
        dynamic(
            "VerifyIndexRequest",
            &v1::VerifyIndexRequest {
                index_name: index.clone(),
                min_revision: revision.clone(),
                query_count: Some(3),
                k: Some(2),
                seed: 1,
            },
        ),
        dynamic(
            "RemoveRequest",
            &v1::RemoveRequest {
                index_name: index.clone(),
                ids: vec![1 << 40],
                uid,
                ..Default::default()
            },
        ),
        dynamic(
            "DeleteIndexRequest",
            &v1::DeleteIndexRequest {
                index_name: index,
                uid: "of another".into(),
            },
        ),
    ]
}

fn dynamic(name: &str, message: &impl Message) -> DynamicMessage {
    let descriptor = pool().get_message_by_name(&format!("wayfold.v1.{name}"));
    DynamicMessage::decode(descriptor.unwrap(), &*message.encode_to_vec()).unwrap()
}

/// `request` with each extreme in each of its integer fields, one at a time, and with random integers in several
/// fields; each variant has a text that identifies it.
pub(crate) fn variants(request: &DynamicMessage) -> Vec<(String, DynamicMessage)> {
    let name = request.descriptor().name().to_owned();
    let paths = integers(&request.descriptor(), DEPTH);
    let mut variants = Vec::new();
    for path in &paths {
        for extreme in EXTREMES {
            let mut variant = request.clone();
            set(&mut variant, path, extreme);
            variants.push((format!("{name}, field {path:?} = {extreme}"), variant));
        }
    }
    for seed in 0..RANDOM {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut variant = request.clone();
        for path in &paths {
            // The server looks only at the first wrong field of a request, so most fields keep their good values.
            if random.random_range(0..3) == 0 {
                let integer = match random.random() {
                    true => random.next_u64() >> random.random_range(0..64),
                    false => *EXTREMES.choose(&mut random).unwrap(),
                };
                set(&mut variant, path, integer);
            }
        }
        variants.push((format!("{name}, seed {seed}"), variant));
    }
    variants
}

/// The paths, by field number, of the integers of a message and of those in it.
fn integers(message: &MessageDescriptor, depth: usize) -> Vec<Vec<u32>> {
    let mut paths = Vec::new();
    for field in message.fields() {
        match field.kind() {
            Kind::Message(within) if depth > 0 => {
                for mut path in integers(&within, depth - 1) {
                    path.insert(0, field.number());
                    paths.push(path);
                }
            }
            Kind::Message(_) | Kind::Float | Kind::Double | Kind::Bool | Kind::String => {}
            Kind::Bytes => {}
            _ => paths.push(vec![field.number()]),
        }
    }
    paths
}

/// Sets the integer at `path`; in a list, the first one.
fn set(message: &mut DynamicMessage, path: &[u32], integer: u64) {
    let (&number, rest) = path.split_first().unwrap();
    let field = message.descriptor().get_field(number).unwrap();
    let value = message.get_field_mut(&field);
    let value = match value {
        Value::List(values) => {
            if values.is_empty() {
                values.push(Value::default_value(&field.kind()));
            }
            &mut values[0]
        }
        value => value,
    };
    if let Value::Message(within) = value {
        return set(within, rest, integer);
    }
    *value = match value {
        Value::U32(_) => Value::U32(integer as u32),
        Value::I32(_) => Value::I32(integer as i32),
        Value::U64(_) => Value::U64(integer),
        Value::I64(_) => Value::I64(integer as i64),
        Value::EnumNumber(_) => Value::EnumNumber(integer as i32),
        other => panic!("{other:?} is no integer"),
    };
}
