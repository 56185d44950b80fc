//! Keys of another prefix that lead to the server, and lose or double what passes.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex},
};

use prost::Message;
use tokio::runtime::Handle;
use wayfold_proto::v1;
use zenoh::{
    Session, Wait,
    bytes::Encoding,
    pubsub::Subscriber,
    query::{ConsolidationMode, Query, Queryable},
};

/// The prefix of the relay.
pub(super) const PREFIX: &str = "relay/v1";

/// The fate of a query and its answer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Fate {
    Answered,
    /// The server does not get it.
    Lost,
    /// The server takes it, and its answer is lost.
    Unanswered,
    AnsweredTwice,
    /// Another server refuses it first.
    Contradicted,
}

/// A relay, until it is dropped.
pub(super) struct Relay {
    counts: Arc<Mutex<HashMap<String, u64>>>,
    _queries: Queryable<()>,
    _events: Subscriber<()>,
}

impl Relay {
    /// A relay on a session. `fate` is asked with the verb, and the number of queries with that verb so far.
    pub(super) async fn open(session: &Session, fate: fn(&str, u64) -> Fate) -> Relay {
        let counts = Arc::new(Mutex::new(HashMap::<String, u64>::new()));
        let runtime = Handle::current();
        let (counting, way) = (Arc::clone(&counts), session.clone());
        let carry_query = move |query: Query| {
            let verb = query.key_expr().as_str().rsplit('/').next().unwrap();
            let count = {
                let mut counts = counting.lock().unwrap();
                let count = counts.entry(verb.to_owned()).or_default();
                *count += 1;
                *count
            };
            let fate = fate(verb, count);
            runtime.spawn(carry(way.clone(), query, fate));
        };
        let (way, mut passed) = (session.clone(), 0);
        // Every third publication is lost.
        let carry_event = move |sample: zenoh::sample::Sample| {
            passed += 1;
            if passed % 3 > 0 {
                let key = sample.key_expr().as_str().replace("wayfold/v1", PREFIX);
                let put = way.put(key, sample.payload().clone());
                put.encoding(sample.encoding().clone()).wait().unwrap();
            }
        };
        let queries = session.declare_queryable(format!("{PREFIX}/**"));
        let events = session.declare_subscriber("wayfold/v1/*/events/states");
        Relay {
            counts,
            _queries: queries.callback(carry_query).await.unwrap(),
            _events: events.callback_mut(carry_event).await.unwrap(),
        }
    }

    /// The number of queries with this verb so far.
    pub(super) fn count(&self, verb: &str) -> u64 {
        self.counts
            .lock()
            .unwrap()
            .get(verb)
            .copied()
            .unwrap_or_default()
    }
}

async fn carry(way: Session, query: Query, fate: Fate) {
    if fate == Fate::Lost {
        return;
    }
    let key = query.key_expr().as_str().replace(PREFIX, "wayfold/v1");
    let selector = format!("{key}?{}", query.parameters());
    let forwarded = way.get(selector).consolidation(ConsolidationMode::None);
    let forwarded = forwarded.payload(query.payload().cloned().unwrap_or_default());
    let forwarded = forwarded.encoding(query.encoding().cloned().unwrap_or_default());
    let Ok(reply) = forwarded.await.unwrap().recv_async().await else {
        return;
    };
    let times = match fate {
        Fate::Answered => 1,
        Fate::Lost | Fate::Unanswered => 0,
        Fate::AnsweredTwice => 2,
        Fate::Contradicted => {
            let status = v1::Status {
                code: 5,
                message: "no such index here".to_owned(),
                ..Default::default()
            };
            let refused = query.reply_err(status.encode_to_vec());
            refused
                .encoding(Encoding::APPLICATION_PROTOBUF)
                .await
                .unwrap();
            1
        }
    };
    for _ in 0..times {
        match reply.result() {
            Ok(sample) => {
                let reply = query.reply(query.key_expr().clone(), sample.payload().clone());
                reply.encoding(sample.encoding().clone()).await.unwrap();
            }
            Err(refusal) => {
                let reply = query.reply_err(refusal.payload().clone());
                reply.encoding(refusal.encoding().clone()).await.unwrap();
            }
        }
    }
}
