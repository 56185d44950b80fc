//! A client over Zenoh.

use std::time::Duration;

use serde_json::{Value, json};
use wayfold_tests::{Process, ServerProcess};
use zenoh::{Config, Session, bytes::Encoding, query::ConsolidationMode};

/// The maximum time of an answer, after which a test fails.
pub(crate) const MAX_WAIT: Duration = Duration::from_secs(60);

/// A server with Zenoh on a free port of loopback, in memory.
pub(crate) fn server() -> (ServerProcess, String) {
    server_with(&[], &[])
}

/// The same with more arguments, and settings by environment.
pub(crate) fn server_with(
    arguments: &[&str],
    settings: &[(&str, &str)],
) -> (ServerProcess, String) {
    server_at("tcp/127.0.0.1:0", arguments, settings)
}

/// The same at a locator.
pub(crate) fn server_at(
    locator: &str,
    arguments: &[&str],
    settings: &[(&str, &str)],
) -> (ServerProcess, String) {
    let program = env!("CARGO_BIN_EXE_server-process");
    let arguments = [&["--zenoh", locator], arguments].concat();
    let mut server = ServerProcess::start_with(program, &arguments, settings);
    let locator = server.zenoh();
    (server, locator)
}

/// A router at a locator.
pub(crate) fn router(at: &str) -> (Process, String) {
    let mut router = Process::start(env!("CARGO_BIN_EXE_router-process"), &[at]);
    let at = router.line().unwrap();
    (router, at)
}

/// A server whose only Zenoh link is to the router at `at`.
pub(crate) fn server_behind(at: &str, data: &[&str], settings: &[(&str, &str)]) -> ServerProcess {
    let retry = json!({ "period_init_ms": 20, "period_max_ms": 100 });
    let behind = json!({ "mode": "client", "connect": { "endpoints": [at], "retry": retry } });
    let behind = behind.to_string();
    let settings = [&[("WAYFOLD_ZENOH__CONFIG", &*behind)][..], settings].concat();
    server_with(data, &settings).0
}

/// A session that finds no peer by itself.
pub(crate) async fn session(mode: &str, listen: &[&str], connect: &[&str]) -> Session {
    let config = json!({
        "mode": mode,
        "listen": { "endpoints": listen },
        "connect": { "endpoints": connect, "retry": { "period_init_ms": 20, "period_max_ms": 100 } },
        "scouting": { "multicast": { "enabled": false }, "gossip": { "enabled": false } },
    });
    let config = Config::from_json5(&config.to_string()).unwrap();
    zenoh::open(config).await.unwrap()
}

/// A session with the server at `locator`.
pub(crate) struct Robot {
    pub(crate) session: Session,
}

/// One answer.
#[derive(Clone, Debug)]
pub(crate) struct Reply {
    /// Its key; that of a refusal is empty.
    pub(crate) key: String,
    pub(crate) encoding: String,
    pub(crate) payload: Vec<u8>,
}

impl Reply {
    pub(crate) fn json(&self) -> Value {
        assert_eq!(self.encoding, "application/json");
        serde_json::from_slice(&self.payload).unwrap()
    }
}

impl Robot {
    pub(crate) async fn connect(locator: &str) -> Self {
        let session = session("client", &[], &[locator]).await;
        Self { session }
    }

    /// All answers and refusals to a query, in their order.
    pub(crate) async fn all(
        &self,
        selector: &str,
        payload: Vec<u8>,
        encoding: Encoding,
    ) -> Vec<Result<Reply, Reply>> {
        let replies = self
            .session
            .get(selector)
            .payload(payload)
            .encoding(encoding)
            .consolidation(ConsolidationMode::None)
            .timeout(MAX_WAIT)
            .await
            .unwrap();
        let mut results = Vec::new();
        while let Ok(reply) = replies.recv_async().await {
            results.push(match reply.into_result() {
                Ok(sample) => Ok(Reply {
                    key: sample.key_expr().to_string(),
                    encoding: sample.encoding().to_string(),
                    payload: sample.payload().to_bytes().into_owned(),
                }),
                Err(refusal) => Err(Reply {
                    key: String::new(),
                    encoding: refusal.encoding().to_string(),
                    payload: refusal.payload().to_bytes().into_owned(),
                }),
            });
        }
        results
    }

    /// The one answer to a query.
    pub(crate) async fn ask(
        &self,
        selector: &str,
        payload: Vec<u8>,
        encoding: Encoding,
    ) -> Result<Reply, Reply> {
        let mut results = self.all(selector, payload, encoding).await;
        assert_eq!(results.len(), 1, "{selector}: {results:?}");
        results.remove(0)
    }

    /// The same in JSON, of a key under the usual prefix; a null is no payload.
    pub(crate) async fn json(&self, selector: &str, body: Value) -> Result<Value, Value> {
        let payload = match body {
            Value::Null => Vec::new(),
            body => body.to_string().into_bytes(),
        };
        let selector = format!("wayfold/v1/{selector}");
        let results = self.ask(&selector, payload, Encoding::APPLICATION_JSON);
        match results.await {
            Ok(results) => Ok(results.json()),
            Err(results) => Err(results.json()),
        }
    }
}

/// The code and the reason of a refusal in JSON.
pub(crate) fn reason(refusal: &Value) -> (i64, &str) {
    let mut details = refusal["details"].as_array().unwrap().iter();
    let info = details.find(|detail| detail["domain"] == "wayfold");
    let reason = info.unwrap()["reason"].as_str().unwrap();
    (refusal["code"].as_i64().unwrap(), reason)
}
