//! Concurrent writers of one index get the answers of the same calls made one by one in the order of their revisions,
//! whatever they prepared before their turn.

use wayfold_index::Space;
use wayfold_proto::v1;
use wayfold_server::service::Service;

use crate::{model::Model, random::Requests, support::*};

const WRITERS: u64 = 6;
const CALLS: usize = 60;

#[derive(Clone, Debug)]
enum Request {
    Insert(v1::InsertRequest),
    Update(v1::UpdateRequest),
    Remove(v1::RemoveRequest),
}

#[derive(Clone, Debug, PartialEq)]
enum Response {
    Insert(Box<v1::InsertResponse>),
    Update(v1::UpdateResponse),
    Remove(v1::RemoveResponse),
}

impl Request {
    /// None for a refused call.
    async fn send(&self, service: &Service) -> Option<Response> {
        Some(match self.clone() {
            Request::Insert(request) => {
                Response::Insert(Box::new(service.insert(&CALL, request).await.ok()?))
            }
            Request::Update(request) => {
                Response::Update(service.update(&CALL, request).await.ok()?)
            }
            Request::Remove(request) => {
                Response::Remove(service.remove(&CALL, request).await.ok()?)
            }
        })
    }

    fn apply(&self, model: &mut Model) -> Option<Response> {
        Some(match self {
            Request::Insert(request) => Response::Insert(Box::new(model.insert(request).ok()?)),
            Request::Update(request) => Response::Update(model.update(request).ok()?),
            Request::Remove(request) => Response::Remove(model.remove(request)),
        })
    }
}

impl Response {
    fn revision(&self) -> u64 {
        match self {
            Response::Insert(response) => response.revision.number(),
            Response::Update(response) => response.revision.number(),
            Response::Remove(response) => response.revision.number(),
        }
    }
}

async fn write(
    service: Service,
    mut requests: Requests,
    only_inserts: bool,
) -> Vec<(Request, Response)> {
    let mut answered = Vec::new();
    for call in 0..CALLS {
        let revision = info(&service, "arm").await.revision;
        let request = match call % 6 {
            4 if !only_inserts => Request::Update(requests.update(revision.number())),
            5 if !only_inserts => Request::Remove(requests.remove()),
            _ => Request::Insert(requests.insert(revision.number())),
        };
        if let Some(response) = request.send(&service).await {
            answered.push((request, response));
        }
    }
    answered
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn calls_at_once_are_calls_one_after_another() {
    for (seed, only_inserts) in [(1, true), (2, false), (3, false)] {
        println!("seed {seed}");
        let (service, uid) = arm("R2*SO2").await;
        let space: Space = "R2*SO2".parse().unwrap();
        let writers = (0..WRITERS).map(|writer| {
            let requests = Requests::new(100 * seed + writer, &space, &uid);
            tokio::spawn(write(service.clone(), requests, only_inserts))
        });
        let mut answered = Vec::new();
        for writer in writers.collect::<Vec<_>>() {
            answered.extend(writer.await.unwrap());
        }
        let mut model = Model::new(space, uid);
        let last = info(&service, "arm").await.revision.number();
        assert!(last > 50, "{last}");
        for revision in 1..=last {
            let of_it = answered
                .iter()
                .filter(|(_, response)| response.revision() == revision);
            // One call made this revision; the others changed nothing after it.
            let (mut made, mut others) = (None, Vec::new());
            for (request, response) in of_it {
                let mut next = model.clone();
                let is_it = made.is_none() && request.apply(&mut next).as_ref() == Some(response);
                match is_it {
                    true => made = Some(next),
                    false => others.push((request, response)),
                }
            }
            model = made.unwrap_or_else(|| panic!("nothing makes revision {revision}"));
            assert_eq!(model.revision, revision);
            for (request, response) in others {
                assert_eq!(request.apply(&mut model).as_ref(), Some(response));
            }
        }
        assert_eq!(model.revision, last);
    }
}
