//! The operations of a script.

use prost::Message;
use wayfold_proto::v1;

/// One call.
#[derive(Clone, Debug)]
pub(crate) enum Op {
    Create(v1::CreateIndexRequest),
    Info(v1::GetIndexRequest),
    List(v1::ListIndexesRequest),
    Delete(v1::DeleteIndexRequest),
    Insert(v1::InsertRequest),
    Update(v1::UpdateRequest),
    Remove(v1::RemoveRequest),
    OpenSession(v1::OpenSessionRequest),
    Write(v1::WriteRequest),
    Get(v1::GetRequest),
    Knn(v1::KnnRequest),
    Query(v1::QueryRequest),
    Log(v1::WatchRequest),
}

impl Op {
    /// The key of the operation over Zenoh, under the prefix.
    pub(crate) fn key(&self) -> String {
        match self {
            Op::Create(_) => "create".into(),
            Op::Info(it) => format!("{}/info", it.index_name),
            Op::List(_) => "list".into(),
            Op::Delete(_) => "delete".into(),
            Op::Insert(it) => format!("{}/insert", it.index_name),
            Op::Update(it) => format!("{}/update", it.index_name),
            Op::Remove(it) => format!("{}/remove", it.index_name),
            Op::OpenSession(it) => format!("{}/session", it.index_name),
            Op::Write(it) => format!("{}/write", it.index_name),
            Op::Get(it) => format!("{}/get", it.index_name),
            Op::Knn(it) => format!("{}/knn", it.index_name),
            Op::Query(it) => format!("{}/query", it.index_name),
            Op::Log(it) => format!("{}/log", it.index_name),
        }
    }

    pub(crate) fn encode(&self) -> Vec<u8> {
        match self {
            Op::Create(it) => it.encode_to_vec(),
            Op::Info(it) => it.encode_to_vec(),
            Op::List(it) => it.encode_to_vec(),
            Op::Delete(it) => it.encode_to_vec(),
            Op::Insert(it) => it.encode_to_vec(),
            Op::Update(it) => it.encode_to_vec(),
            Op::Remove(it) => it.encode_to_vec(),
            Op::OpenSession(it) => it.encode_to_vec(),
            Op::Write(it) => it.encode_to_vec(),
            Op::Get(it) => it.encode_to_vec(),
            Op::Knn(it) => it.encode_to_vec(),
            Op::Query(it) => it.encode_to_vec(),
            Op::Log(it) => it.encode_to_vec(),
        }
    }

    /// The fields that hold the uid.
    pub(crate) fn uids(&mut self) -> Vec<&mut String> {
        match self {
            Op::Create(_) | Op::Info(_) | Op::List(_) => Vec::new(),
            Op::Delete(it) => vec![&mut it.uid],
            Op::Insert(it) => {
                let spec = it.neighbor_spec.as_mut();
                let since = spec.and_then(|spec| since(&mut spec.filter));
                since.into_iter().chain([&mut it.uid]).collect()
            }
            Op::Update(it) => {
                let revision = it.if_revision.iter_mut().map(|it| &mut it.uid);
                revision.chain([&mut it.uid]).collect()
            }
            Op::Remove(it) => vec![&mut it.uid],
            Op::OpenSession(it) => vec![&mut it.uid],
            Op::Write(it) => vec![&mut it.uid],
            Op::Get(it) => it.min_revision.iter_mut().map(|it| &mut it.uid).collect(),
            Op::Knn(it) => {
                let min = it.min_revision.iter_mut().map(|it| &mut it.uid);
                min.chain(since(&mut it.filter)).collect()
            }
            Op::Query(it) => {
                let min = it.min_revision.iter_mut().map(|it| &mut it.uid);
                min.chain(since(&mut it.filter)).collect()
            }
            Op::Log(it) => it.after_revision.iter_mut().map(|it| &mut it.uid).collect(),
        }
    }
}

/// The uid of the revision that a filter names.
fn since(filter: &mut Option<v1::Filter>) -> Option<&mut String> {
    let revision = filter.as_mut()?.since_revision.as_mut()?;
    Some(&mut revision.uid)
}
