//! The targets of the script: the service in this process and the interfaces of servers.

use std::sync::Arc;

use prost::Message;
use wayfold_proto::v1;
use wayfold_server::{
    log::MemoryLog,
    registry::{Registry, RegistryOptions},
    service::{Call, Limits, Service},
};
use wayfold_tests::{ServerProcess, Stubs, number};
use zenoh::bytes::Encoding;

use super::{
    json,
    op::Op,
    outcome::{Outcome, UID, refused_json},
};
use crate::robot::{Robot, server};

enum Transport {
    Service(Service),
    Grpc(Box<Stubs>),
    Zenoh(Robot, Form),
}

#[derive(Clone, Copy, PartialEq)]
enum Form {
    Protobuf,
    Json,
}

pub(crate) struct Target {
    way: Transport,
    /// The uid of the index "arm" of this target, once it exists.
    uid: String,
    _server: Option<ServerProcess>,
}

impl Target {
    pub(crate) fn service() -> Self {
        let log = Arc::new(MemoryLog::default());
        let registry = Registry::new(log, RegistryOptions::default());
        let service = Service::new(registry, Limits::default());
        service.set_ready();
        Self::of(Transport::Service(service), None)
    }

    /// The interfaces, each of its own server.
    pub(crate) async fn faces() -> [Self; 3] {
        let (grpc, _) = server();
        let stubs = Box::new(Stubs::connect(grpc.uri()).await);
        let (protobuf, at_protobuf) = server();
        let robot = Robot::connect(&at_protobuf).await;
        let (json, at_json) = server();
        let other = Robot::connect(&at_json).await;
        [
            Self::of(Transport::Grpc(stubs), Some(grpc)),
            Self::of(Transport::Zenoh(robot, Form::Protobuf), Some(protobuf)),
            Self::of(Transport::Zenoh(other, Form::Json), Some(json)),
        ]
    }

    fn of(way: Transport, server: Option<ServerProcess>) -> Self {
        Self {
            way,
            uid: String::new(),
            _server: server,
        }
    }

    pub(crate) fn name(&self) -> &'static str {
        match &self.way {
            Transport::Service(_) => "service",
            Transport::Grpc(_) => "gRPC",
            Transport::Zenoh(_, Form::Protobuf) => "Zenoh with Protocol Buffers",
            Transport::Zenoh(_, Form::Json) => "Zenoh with JSON",
        }
    }

    pub(crate) fn has(&self, op: &Op) -> bool {
        !matches!((&self.way, op), (Transport::Grpc(_), Op::Log(_)))
    }

    pub(crate) async fn perform(&mut self, op: &Op) -> Outcome {
        let mut op = op.clone();
        for uid in op.uids() {
            if uid == UID {
                uid.clone_from(&self.uid);
            }
        }
        let answer = match &mut self.way {
            Transport::Service(service) => by_service(service, op).await,
            Transport::Grpc(stubs) => by_grpc(stubs, op).await,
            Transport::Zenoh(robot, form) => by_zenoh(robot, *form, op).await,
        };
        let outcome = match answer {
            Ok(mut answer) => {
                match &mut answer {
                    Answer::Create(v1::CreateIndexResponse {
                        index: Some(index), ..
                    }) => match &*index.name {
                        "arm" => self.uid.clone_from(uid(index)),
                        _ => uid(index).clear(),
                    },
                    Answer::Delete(deleted) if deleted.uid != self.uid => deleted.uid.clear(),
                    _ => {}
                }
                answer.outcome()
            }
            Err(refused) => refused,
        };
        outcome.with_uid(&self.uid)
    }
}

/// An answer, by its kind.
pub(crate) enum Answer {
    Create(v1::CreateIndexResponse),
    Info(v1::GetIndexResponse),
    List(v1::ListIndexesResponse),
    Delete(v1::DeleteIndexResponse),
    Insert(v1::InsertResponse),
    Update(v1::UpdateResponse),
    Remove(v1::RemoveResponse),
    OpenSession(v1::OpenSessionResponse),
    Write(v1::WriteResponse),
    Get(v1::GetResponse),
    Knn(v1::KnnResponse),
    Query(v1::QueryResponse),
    Log(v1::WatchResponse),
}

impl Answer {
    /// Leaves out the values that differ at each time and place.
    fn outcome(self) -> Outcome {
        let plain = |mut index: v1::Index| {
            index.memory_bytes = 0;
            index
        };
        match self {
            Answer::Create(mut it) => {
                it.index = it.index.map(plain);
                Outcome::answered(&it, 0)
            }
            Answer::Info(mut it) => {
                it.index = it.index.map(plain);
                let revision = it.index.as_ref().unwrap().revision.clone();
                Outcome::answered(&it, number(&revision))
            }
            Answer::List(mut it) => {
                it.indexes = it.indexes.into_iter().map(plain).collect();
                for index in &mut it.indexes {
                    if index.name != "arm" {
                        uid(index).clear();
                    }
                }
                Outcome::answered(&it, 0)
            }
            Answer::Delete(it) => Outcome::answered(&it, 0),
            Answer::Insert(it) => Outcome::answered(&it, number(&it.revision)),
            Answer::Update(it) => Outcome::answered(&it, number(&it.revision)),
            Answer::Remove(it) => Outcome::answered(&it, number(&it.revision)),
            Answer::OpenSession(it) => Outcome::answered(&it, number(&it.revision)),
            Answer::Write(it) => Outcome::answered(&it, number(&it.revision)),
            Answer::Get(it) => Outcome::answered(&it, number(&it.revision)),
            Answer::Knn(it) => Outcome::answered(&it, number(&it.revision)),
            Answer::Query(it) => Outcome::answered(&it, number(&it.revision)),
            Answer::Log(mut it) => {
                for mutation in &mut it.mutations {
                    mutation.time_ms = 0;
                }
                Outcome::answered(&it, number(&it.revision))
            }
        }
    }
}

/// The uid of an index that an answer describes.
fn uid(index: &mut v1::Index) -> &mut String {
    &mut index.revision.as_mut().unwrap().uid
}

async fn by_service(service: &Service, op: Op) -> Result<Answer, Outcome> {
    let call = Call::default();
    Ok(match op {
        Op::Create(it) => Answer::Create(service.create_index(&call, it).await?),
        Op::Info(it) => Answer::Info(service.get_index(&call, it).await?),
        Op::List(it) => {
            let listed = service.list_indexes(&call, it).await?;
            Answer::List(v1::ListIndexesResponse {
                indexes: listed.indexes,
                next_page_token: listed.next_page_token,
                damaged: Vec::new(),
            })
        }
        Op::Delete(it) => Answer::Delete(service.delete_index(&call, it).await?),
        Op::Insert(it) => Answer::Insert(service.insert(&call, it).await?),
        Op::Update(it) => Answer::Update(service.update(&call, it).await?),
        Op::Remove(it) => Answer::Remove(service.remove(&call, it).await?),
        Op::OpenSession(it) => Answer::OpenSession(service.open_session(&call, it).await?),
        Op::Write(it) => Answer::Write(service.write(&call, it).await?),
        Op::Get(it) => Answer::Get(service.get(&call, it).await?),
        Op::Knn(it) => Answer::Knn(service.knn(&call, it).await?),
        Op::Query(it) => Answer::Query(service.query(&call, it).await?),
        Op::Log(it) => Answer::Log(service.log(&call, it).await?),
    })
}

async fn by_grpc(stubs: &mut Stubs, op: Op) -> Result<Answer, Outcome> {
    let (indexes, points) = (&mut stubs.indexes, &mut stubs.points);
    Ok(match op {
        Op::Create(it) => Answer::Create(indexes.create_index(it).await?.into_inner()),
        Op::Info(it) => Answer::Info(indexes.get_index(it).await?.into_inner()),
        Op::List(it) => Answer::List(indexes.list_indexes(it).await?.into_inner()),
        Op::Delete(it) => Answer::Delete(indexes.delete_index(it).await?.into_inner()),
        Op::Insert(it) => Answer::Insert(points.insert(it).await?.into_inner()),
        Op::Update(it) => Answer::Update(points.update(it).await?.into_inner()),
        Op::Remove(it) => Answer::Remove(points.remove(it).await?.into_inner()),
        Op::OpenSession(it) => Answer::OpenSession(points.open_session(it).await?.into_inner()),
        Op::Write(it) => Answer::Write(points.write(it).await?.into_inner()),
        Op::Get(it) => Answer::Get(points.get(it).await?.into_inner()),
        Op::Knn(it) => Answer::Knn(points.knn(it).await?.into_inner()),
        Op::Query(it) => Answer::Query(points.query(it).await?.into_inner()),
        Op::Log(_) => panic!("gRPC has Watch"),
    })
}

async fn by_zenoh(robot: &Robot, form: Form, op: Op) -> Result<Answer, Outcome> {
    let (payload, encoding) = match form {
        Form::Protobuf => (op.encode(), Encoding::APPLICATION_PROTOBUF),
        Form::Json => (
            json::request(&op).to_string().into_bytes(),
            Encoding::APPLICATION_JSON,
        ),
    };
    let key = format!("wayfold/v1/{}", op.key());
    let answered = robot.ask(&key, payload, encoding.clone()).await;
    let (Ok(answer) | Err(answer)) = &answered;
    assert_eq!(answer.encoding, encoding.to_string());
    match (answered, form) {
        (Ok(answered), Form::Protobuf) => Ok(decode(&op, &answered.payload)),
        (Err(answered), Form::Protobuf) => {
            Err(v1::Status::decode(&*answered.payload).unwrap().into())
        }
        (Ok(answered), Form::Json) => Ok(json::answer(&op, &answered.json())),
        (Err(answered), Form::Json) => Err(refused_json(&answered.json())),
    }
}

fn decode(op: &Op, bytes: &[u8]) -> Answer {
    fn one<M: Message + Default>(bytes: &[u8]) -> M {
        M::decode(bytes).unwrap()
    }
    match op {
        Op::Create(_) => Answer::Create(one(bytes)),
        Op::Info(_) => Answer::Info(one(bytes)),
        Op::List(_) => Answer::List(one(bytes)),
        Op::Delete(_) => Answer::Delete(one(bytes)),
        Op::Insert(_) => Answer::Insert(one(bytes)),
        Op::Update(_) => Answer::Update(one(bytes)),
        Op::Remove(_) => Answer::Remove(one(bytes)),
        Op::OpenSession(_) => Answer::OpenSession(one(bytes)),
        Op::Write(_) => Answer::Write(one(bytes)),
        Op::Get(_) => Answer::Get(one(bytes)),
        Op::Knn(_) => Answer::Knn(one(bytes)),
        Op::Query(_) => Answer::Query(one(bytes)),
        Op::Log(_) => Answer::Log(one(bytes)),
    }
}
