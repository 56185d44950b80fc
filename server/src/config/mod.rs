//! The settings: `default.toml`, overridden by `--config FILE`, the environment and the flags, in this order.

mod error;
mod layers;
mod memory;
mod nearest;

use std::{collections::BTreeMap, path::Path, time::Duration};

use serde::Deserialize;

pub use crate::admission::AdmissionConfig;
pub use error::ConfigError;
pub use memory::MemoryConfig;

use crate::{
    log::{Durability, NatsOptions},
    observe::LogFormat,
    registry::RegistryOptions,
    service::Limits,
};

/// The default settings, commented.
pub const DEFAULTS: &str = include_str!("../default.toml");

/// All settings. `default.toml` explains each.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct Config {
    /// The gRPC face.
    pub grpc: GrpcConfig,
    /// The certificates of the gRPC face.
    pub tls: TlsConfig,
    /// The callers and their rights.
    pub access: AccessConfig,
    /// The Zenoh face.
    pub zenoh: ZenohConfig,
    /// The pages for operators.
    pub http: HttpConfig,
    /// The bounds on the time and the memory of the server that calls may take.
    pub admission: AdmissionConfig,
    /// Limits on calls.
    pub limits: Limits,
    /// The structure of the indices in memory.
    pub index: IndexConfig,
    /// Threads.
    pub runtime: RuntimeConfig,
    /// Shutdown.
    pub shutdown: ShutdownConfig,
    /// Log lines.
    pub log: LogConfig,
    /// Storage of the indices.
    pub data: DataConfig,
    /// The journal that several servers share.
    pub cluster: ClusterConfig,
    /// The watermarks of memory.
    pub memory: MemoryConfig,
    /// The watermark of the disk.
    pub disk: DiskConfig,
    /// The snapshots that the server takes.
    pub snapshot: SnapshotConfig,
}

/// `[grpc]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct GrpcConfig {
    /// The address to listen on, as `host:port`.
    pub listen: String,
    /// The largest request message, in bytes.
    pub max_message_bytes: usize,
    /// The most calls in flight on one connection, streams included.
    pub max_calls_per_connection: u32,
    /// The most open connections.
    pub max_connections: usize,
    /// The time in which a request must arrive, in milliseconds.
    pub receive_timeout_ms: u64,
    /// The time in which a client must read some of the answers that wait for it, in milliseconds.
    pub send_timeout_ms: u64,
    /// The deadline of a call that has none and that is no stream, in milliseconds.
    pub default_timeout_ms: u64,
    /// The most requests of one `StreamKnn` that are evaluated at a time.
    pub stream_window: usize,
    /// A connection is probed after this much silence, in milliseconds; 0 for never.
    pub keepalive_interval_ms: u64,
    /// A probed connection is closed without an answer after this time, in milliseconds.
    pub keepalive_timeout_ms: u64,
}

/// `[tls]`: files in PEM, or [`OFF`].
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct TlsConfig {
    /// The certificate of the server, and those between it and its authority.
    pub certificate: String,
    /// Its private key.
    pub key: String,
    /// The authorities of the certificates of clients.
    pub client_ca: String,
}

impl TlsConfig {
    /// The file of the certificate, if there is one.
    pub(crate) fn certificate(&self) -> Option<&Path> {
        file(&self.certificate)
    }

    /// The file of the key, if there is one.
    pub(crate) fn key(&self) -> Option<&Path> {
        file(&self.key)
    }

    /// The file of the authorities, if there is one.
    pub(crate) fn client_ca(&self) -> Option<&Path> {
        file(&self.client_ca)
    }
}

/// `[access]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct AccessConfig {
    /// The file of the identities, or [`OFF`].
    pub identities: String,
    /// [`ON`] if the mutations of indices are published over Zenoh to every subscriber, without a check of its identity.
    pub publish_events: String,
    /// [`ON`] if the server may listen beyond this machine without TLS or identities.
    pub insecure: String,
}

impl AccessConfig {
    /// The file of the identities, if there is one.
    pub(crate) fn identities(&self) -> Option<&Path> {
        file(&self.identities)
    }
}

/// The least `max_payload` of NATS: a larger mutation is one batch of up to 1,000 messages, 63 MB of records here. That is four
/// times the largest message of a client without another setting.
const MIN_PAYLOAD: usize = 64 * 1024;

/// The value of a setting that is turned off.
pub const OFF: &str = "off";

/// The value of a switch that is turned on.
pub const ON: &str = "on";

fn file(setting: &str) -> Option<&Path> {
    (setting != OFF).then(|| Path::new(setting))
}

/// `[zenoh]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct ZenohConfig {
    /// The locator to listen on, as `tcp/host:port`, or [`ZenohConfig::OFF`].
    pub listen: String,
    /// The prefix of every key.
    pub prefix: String,
    /// The most queries in flight.
    pub max_calls: usize,
    /// The deadline of a query that has none, in milliseconds.
    pub default_timeout_ms: u64,
    /// The largest payload of a query, in bytes.
    pub max_message_bytes: usize,
    /// Further settings of Zenoh, in JSON5.
    pub config: String,
}

impl ZenohConfig {
    /// The locator that turns Zenoh off.
    pub const OFF: &str = "off";

    /// True if Zenoh is off.
    pub(crate) fn is_off(&self) -> bool {
        self.listen == Self::OFF
    }
}

/// `[http]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct HttpConfig {
    /// The address to listen on, as `host:port`, or [`OFF`].
    pub listen: String,
}

/// `[index]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct IndexConfig {
    /// The greatest number of points in the tree that grows; 0 to choose it by the space.
    pub growing_rows: usize,
    /// Points in a leaf.
    pub leaf_rows: usize,
    /// The most merges at a time, over all indices.
    pub merge_threads: usize,
    /// Bytes of recent mutations that each index keeps, about.
    pub window_bytes: usize,
    /// The age up to which it keeps them, in seconds.
    pub window_seconds: u64,
}

impl IndexConfig {
    pub(crate) fn options(&self, limits: &Limits) -> RegistryOptions {
        RegistryOptions {
            growing_rows: (self.growing_rows > 0).then_some(self.growing_rows),
            leaf_rows: Some(self.leaf_rows),
            merge_threads: self.merge_threads,
            window_bytes: self.window_bytes,
            window: Duration::from_secs(self.window_seconds),
            operations: limits.operations(),
            counts_payloads: limits.max_payload_bytes_per_index > 0,
        }
    }
}

/// `[runtime]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct RuntimeConfig {
    /// Threads that answer calls; 0 for one per core.
    pub workers: usize,
}

/// `[shutdown]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct ShutdownConfig {
    /// The time that accepted calls have to finish, in milliseconds.
    pub grace_ms: u64,
}

/// `[log]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct LogConfig {
    /// The filter of log lines: a level, or levels by module.
    pub filter: String,
    /// The form of log lines.
    pub format: LogFormat,
    /// The time from which on a call with one answer is slow, in milliseconds; 0: never.
    pub slow_call_ms: u64,
}

/// `[data]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct DataConfig {
    /// The directory of the indices, or [`DataConfig::MEMORY`].
    pub dir: String,
    /// The failures that an acknowledged mutation survives.
    pub durability: Durability,
}

impl DataConfig {
    /// The directory that stands for none: indices are kept in memory only.
    pub const MEMORY: &str = "memory";

    /// The directory; None if the indices are kept in memory.
    pub(crate) fn directory(&self) -> Option<&Path> {
        (self.dir != Self::MEMORY).then(|| Path::new(&self.dir))
    }
}

/// `[cluster]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct ClusterConfig {
    /// The URLs of the servers of NATS, separated by commas, or [`OFF`].
    pub nats: String,
    /// The name before those of the streams and the bucket.
    pub name: String,
    /// The number of servers of NATS that store each record.
    pub replicas: usize,
    /// The file of the credentials for NATS, or [`OFF`].
    pub credentials: String,
    /// The file of the authorities of NATS's certificates, or [`OFF`].
    pub ca: String,
    /// The address on which the server listens for the other members, as `host:port`.
    pub listen: String,
    /// The address at which they reach it, as `host:port`, or [`OFF`] if it is the one that it listens on.
    pub advertise: String,
    /// The file of the authorities of the members' certificates, or [`OFF`].
    pub peer_ca: String,
}

impl ClusterConfig {
    /// True if the server shares its journal with others.
    pub(crate) fn is_on(&self) -> bool {
        self.nats != OFF
    }

    /// The file of the authorities of the members' certificates, if there is one.
    pub(crate) fn peer_ca(&self) -> Option<&Path> {
        file(&self.peer_ca)
    }

    /// The shared journal; None if this server has its own.
    pub(crate) fn options(&self) -> Option<NatsOptions> {
        self.is_on().then(|| NatsOptions {
            min_payload: MIN_PAYLOAD,
            servers: self.nats.clone(),
            name: self.name.clone(),
            replicas: self.replicas,
            credentials: file(&self.credentials).map(Path::to_path_buf),
            ca: file(&self.ca).map(Path::to_path_buf),
        })
    }
}

/// `[disk]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct DiskConfig {
    /// The free bytes of the disk below which growth is refused; 0 for none.
    pub min_free_bytes: u64,
}

/// `[snapshot]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct SnapshotConfig {
    /// The directory of the snapshots, or [`OFF`].
    pub dir: String,
    /// The time between two snapshots of an index, in seconds.
    pub every_seconds: u64,
    /// The most snapshots of an index.
    pub keep: usize,
}

impl SnapshotConfig {
    /// The directory, if the server takes snapshots.
    pub(crate) fn directory(&self) -> Option<&Path> {
        file(&self.dir)
    }
}

impl Config {
    /// Loads the settings from all layers: the defaults, the `file` if given, the `environment`, and the `flags`, which
    /// are pairs of a key such as `grpc.listen` and its value. A later layer overrides an earlier one.
    pub fn load(
        file: Option<&Path>,
        environment: &BTreeMap<String, String>,
        flags: &[(&str, String)],
    ) -> Result<Self, ConfigError> {
        let mut config = layers::load(file, environment, flags)?;
        config.fit_into_memory();
        Ok(config)
    }
}

impl Default for Config {
    fn default() -> Self {
        Self::load(None, &BTreeMap::new(), &[]).expect("default.toml is valid")
    }
}
