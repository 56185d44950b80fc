//! The Zenoh session: opened from the settings, closed by its drop.

use std::{io, net::TcpListener, sync::mpsc, thread, time::Duration};

use serde_json::{Value, json};
use thiserror::Error;
use tracing::warn;
use zenoh::{
    Config, Session, Wait,
    config::EndPoint,
    internal::runtime::{Runtime, RuntimeBuilder},
    key_expr::OwnedKeyExpr,
};

use crate::{
    config::ZenohConfig,
    exposure::{ExposedAddress, is_local},
    redact,
};

/// Time after which a peer that does not read its answers is disconnected, in microseconds.
const WAIT_FOR_PEER_US: u64 = 1_000_000;

/// Time that a publication waits for room on a link before it is dropped, in microseconds.
const WAIT_FOR_ROOM_US: u64 = 10_000;

/// Time in which a new connection must become a session, in milliseconds. Zenoh's own 10 s let few silent strangers keep
/// everybody out.
const ACCEPT_TIME_MS: u64 = 2_000;

/// The most connections that are no sessions yet: Zenoh closes further ones at once.
pub(crate) const MAX_PENDING: usize = 1_000;

/// The most sessions: Zenoh refuses further ones.
pub(crate) const MAX_SESSIONS: usize = 1_000;

/// Zenoh drops messages larger than this many times the largest payload silently; smaller ones get a refusal.
const MESSAGE_LIMIT_FACTOR: usize = 4;

/// A drop waits this long until the links are closed. Zenoh tells each peer, and waits for those that do not read, one
/// message after the other.
const CLOSE_WAIT: Duration = Duration::from_secs(1);

/// The error of the Zenoh face.
#[derive(Debug, Error)]
pub enum ZenohError {
    /// `zenoh.config` is not a configuration.
    #[error("zenoh.config: {problem}")]
    Config {
        /// The problem.
        problem: String,
    },
    /// `zenoh.prefix` cannot be the beginning of keys.
    #[error("zenoh.prefix: {prefix:?} is no key: {problem}; an example: wayfold/v1")]
    Prefix {
        /// The prefix.
        prefix: String,
        /// The problem.
        problem: String,
    },
    /// `zenoh.listen` is not an address.
    #[error(
        "zenoh.listen: {listen:?} is no address to listen on: {problem}; examples: tcp/127.0.0.1:7448, \
         tls/0.0.0.0:7448, off"
    )]
    Listen {
        /// Its value.
        listen: String,
        /// The problem.
        problem: String,
    },
    /// Another program listens on the address.
    #[error(
        "cannot open the Zenoh session on {listen}: the address is in use\n  \
         another program listens there, perhaps another wayfold-server: stop it, or choose another port; \
         --zenoh tcp/127.0.0.1:0 takes any free one, --zenoh off does without"
    )]
    InUse {
        /// The address.
        listen: String,
    },
    /// The session could not be opened.
    #[error(
        "cannot open the Zenoh session on {listen}: {problem}\n  \
         zenoh.listen (--zenoh) sets the address to listen on, and zenoh.config the rest, such as the peers to connect \
         to; --zenoh off does without"
    )]
    Open {
        /// The address.
        listen: String,
        /// The problem.
        problem: String,
    },
    /// A declaration of the face failed.
    #[error("Zenoh: {problem}")]
    Declare {
        /// The problem.
        problem: String,
    },
}

impl ZenohError {
    pub(super) fn declare(problem: zenoh::Error) -> Self {
        ZenohError::Declare {
            problem: problem.to_string(),
        }
    }
}

/// A session and its runtime, which it does not close: dropping this closes both.
pub(super) struct ZenohRuntime {
    pub(super) session: Session,
    pub(super) runtime: Runtime,
}

impl Drop for ZenohRuntime {
    fn drop(&mut self) {
        if self.runtime.is_closed() {
            return;
        }
        let (session, runtime) = (self.session.clone(), self.runtime.clone());
        let (done, closed) = mpsc::channel();
        let closing = thread::Builder::new().name("wayfold-zenoh".into());
        let closing = closing.spawn(move || {
            // An open session panics if the runtime under it closes.
            let closed = session.close().wait();
            if let Err(error) = closed.and_then(|()| runtime.close().wait()) {
                warn!(%error, "the links of Zenoh did not close well");
            }
            // The drop may have gone on.
            let _ = done.send(());
        });
        match closing {
            Ok(_) => drop(closed.recv_timeout(CLOSE_WAIT)),
            Err(error) => warn!(%error, "the links of Zenoh stay open until the process ends"),
        }
    }
}

/// Opens the session; returns it with the endpoints that it connects to, if any.
pub(super) async fn open(
    config: &ZenohConfig,
) -> Result<(ZenohRuntime, Option<String>), ZenohError> {
    let settings = settings(config)?;
    let connects_to = settings.get_json("connect/endpoints").ok();
    let connects_to = connects_to.filter(|endpoints| !matches!(&**endpoints, "[]" | "null" | "{}"));
    let connects_to = connects_to.map(|endpoints| without_options(&endpoints));
    // Tried before: a session that fails to open may still hold the address for a moment.
    let is_in_use = is_in_use(&config.listen);
    let open = start(settings).await.map_err(|error| {
        let listen = without_options(&config.listen);
        let problem = without_options(&without_places(&error.to_string()));
        match is_in_use {
            true => ZenohError::InUse { listen },
            false => ZenohError::Open { listen, problem },
        }
    })?;
    Ok((open, connects_to))
}

/// Does the work of `zenoh::open`, which hides the runtime.
async fn start(settings: Config) -> Result<ZenohRuntime, zenoh::Error> {
    let keys = |setting| -> Vec<OwnedKeyExpr> {
        let keys = settings.get_json(setting).unwrap_or_default();
        serde_json::from_str(&keys).unwrap_or_default()
    };
    let subscribers = keys("aggregation/subscribers");
    let publishers = keys("aggregation/publishers");
    let runtime = RuntimeBuilder::new(settings).build().await?;
    let session = zenoh::session::init(runtime.clone().into())
        .aggregated_subscribers(subscribers)
        .aggregated_publishers(publishers)
        .await?;
    let mut open = ZenohRuntime { session, runtime };
    open.runtime.start().await?;
    Ok(open)
}

/// True if another program listens at this address. Zenoh reports the cause of a failure only as text.
fn is_in_use(listen: &str) -> bool {
    let endpoint = listen.parse::<EndPoint>().ok();
    let bound = endpoint.map(|endpoint| TcpListener::bind(endpoint.address().as_str()));
    matches!(bound, Some(Err(error)) if error.kind() == io::ErrorKind::AddrInUse)
}

/// The addresses that reach beyond this machine.
pub(crate) fn exposed(config: &ZenohConfig) -> Result<Vec<ExposedAddress>, ZenohError> {
    if config.is_off() {
        return Ok(Vec::new());
    }
    let settings = settings(config)?;
    let mut exposed = Vec::new();
    for setting in ["listen/endpoints", "connect/endpoints"] {
        let endpoints = settings.get_json(setting).unwrap_or_default();
        let endpoints = serde_json::from_str(&endpoints).unwrap_or(Value::Null);
        for endpoint in texts(&endpoints) {
            let (protocol, address) = endpoint.split_once('/').unwrap_or(("", endpoint));
            let host = address.rsplit_once(':').map_or(address, |(host, _)| host);
            if !is_local(host) {
                exposed.push(ExposedAddress {
                    address: format!("Zenoh's {setting}: {}", without_options(endpoint)),
                    has_tls: protocol == "tls",
                });
            }
        }
    }
    for scouting in ["scouting/multicast/enabled", "scouting/gossip/enabled"] {
        // Zenoh's own default, which null stands for, is on.
        if settings.get_json(scouting).is_ok_and(|on| on != "false") {
            exposed.push(ExposedAddress {
                address: format!("Zenoh's {scouting}"),
                has_tls: false,
            });
        }
    }
    Ok(exposed)
}

/// All texts in a value: endpoints may be listed, and by the mode of the session.
fn texts(value: &Value) -> Vec<&str> {
    match value {
        Value::String(text) => vec![text],
        Value::Array(values) => values.iter().flat_map(texts).collect(),
        Value::Object(values) => values.values().flat_map(texts).collect(),
        _ => Vec::new(),
    }
}

fn check_listen(listen: &str) -> Result<(), ZenohError> {
    let wrong = |problem: String| ZenohError::Listen {
        listen: without_options(listen),
        problem,
    };
    let endpoint: EndPoint = listen
        .parse()
        .map_err(|_| wrong("it is not PROTOCOL/HOST:PORT".into()))?;
    match endpoint.protocol().as_str() {
        "tcp" | "tls" => Ok(()),
        other => Err(wrong(format!(
            "{other} is not spoken here, but tcp and tls are"
        ))),
    }
}

/// Removes the options of endpoints from a text, `#connect_private_key_base64=…`: some are secrets.
fn without_options(text: &str) -> String {
    let mut shown = String::new();
    let mut rest = text;
    while let Some((before, options)) = rest.split_once('#') {
        shown.push_str(before);
        let ends = |c: char| c.is_whitespace() || "\"',])}".contains(c);
        rest = &options[options.find(ends).unwrap_or(options.len())..];
    }
    shown + rest
}

/// Removes the places in Zenoh's source from its errors: " at /…/orchestrator.rs:447.".
fn without_places(problem: &str) -> String {
    let mut cleaned = String::new();
    let mut rest = problem;
    while let Some(at) = rest.find(" at /") {
        let place = &rest[at..];
        let Some(line) = place.find(".rs:") else {
            break;
        };
        cleaned.push_str(&rest[..at]);
        rest = place[line + 4..].trim_start_matches(|c: char| c.is_ascii_digit() || c == '.');
    }
    cleaned + rest
}

/// The settings of this face, overridden by `zenoh.config`, which may set any option of Zenoh.
fn settings(config: &ZenohConfig) -> Result<Config, ZenohError> {
    check_listen(&config.listen)?;
    let wrong = |problem: String| ZenohError::Config { problem };
    let mut settings = json!({
        "mode": "peer",
        "listen": { "endpoints": [config.listen], "exit_on_failure": true, "timeout_ms": 0 },
        "scouting": { "multicast": { "enabled": false }, "gossip": { "enabled": false } },
        "transport": {
            "unicast": {
                "accept_timeout": ACCEPT_TIME_MS,
                "accept_pending": MAX_PENDING,
                "max_sessions": MAX_SESSIONS,
            },
            "link": {
                "rx": { "max_message_size": MESSAGE_LIMIT_FACTOR.saturating_mul(config.max_message_bytes) },
                "tx": { "queue": { "congestion_control": {
                    "block": { "wait_before_close": WAIT_FOR_PEER_US },
                    "drop": { "wait_before_drop": WAIT_FOR_ROOM_US },
                } } },
            },
        },
    });
    let over: Value = json5::from_str(&config.config).map_err(|error| wrong(place(error)))?;
    if !over.is_object() {
        return Err(wrong("it is not an object: { … }".into()));
    }
    // The user's own rules replace all of these: a mixture would be neither.
    if over.get("access_control").is_none() {
        settings["access_control"] = access_control();
    }
    lay_over(&mut settings, over);
    Config::from_json5(&settings.to_string()).map_err(|error| {
        let problem = redact::without_value(&error.to_string());
        wrong(problem.unwrap_or_else(|| "Zenoh does not take one of its values".into()))
    })
}

/// Lets links bring queries and subscriptions, and nothing that Zenoh would take to another link: an answer in the
/// server's place, a publication of mutations that never were, or a queryable that reads the tokens of others.
fn access_control() -> Value {
    json!({
        "enabled": true,
        "default_permission": "allow",
        "rules": [{
            "id": "relayed",
            "permission": "deny",
            "flows": ["ingress"],
            "messages": ["declare_queryable", "reply", "put", "delete", "liveliness_token"],
            // A rule holds for the keys that it includes whole, so one of the prefix would let `**` pass. A `**` leaves
            // out parts with an `@`: tokens of other servers are taken, because this server warns of those.
            "key_exprs": ["**", "**/@alive/**"],
        }],
        "subjects": [{ "id": "everyone" }],
        "policies": [{ "rules": ["relayed"], "subjects": ["everyone"] }],
    })
}

/// The place of a syntax error. The message of JSON5 shows the line, which may have a password.
fn place(error: json5::Error) -> String {
    let json5::Error::Message { msg, location } = error;
    location.map_or(msg, |at| {
        format!("it is no JSON5 at line {}, column {}", at.line, at.column)
    })
}

/// Overrides one value with another; objects are merged.
fn lay_over(under: &mut Value, over: Value) {
    match (under, over) {
        (Value::Object(under), Value::Object(over)) => {
            for (name, value) in over {
                lay_over(under.entry(name).or_insert(Value::Null), value);
            }
        }
        (under, over) => *under = over,
    }
}

#[cfg(test)]
mod tests;
