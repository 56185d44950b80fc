//! The settings: `default.toml`, then `--config FILE`, then the environment, then flags.

mod error;
mod layers;
mod nearest;

use std::{collections::BTreeMap, path::Path, time::Duration};

use serde::Deserialize;

pub use error::ConfigError;

use crate::{log::Durability, observe::LogFormat, registry::RegistryOptions, service::Limits};

/// The default settings, commented.
pub const DEFAULTS: &str = include_str!("../default.toml");

/// All settings. `default.toml` explains each.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct Config {
    /// The gRPC face.
    pub grpc: GrpcConfig,
    /// The Zenoh face.
    pub zenoh: ZenohConfig,
    /// What a call may ask for.
    pub limits: Limits,
    /// The structure of the indices.
    pub index: IndexConfig,
    /// Threads.
    pub runtime: RuntimeConfig,
    /// Stopping.
    pub shutdown: ShutdownConfig,
    /// Log lines.
    pub log: LogConfig,
    /// Where the indices are kept.
    pub data: DataConfig,
}

/// `[grpc]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct GrpcConfig {
    /// The address to listen on, as `host:port`.
    pub listen: String,
    /// The largest request message in bytes.
    pub max_message_bytes: usize,
    /// Most calls under way.
    pub max_calls: usize,
    /// Most calls under way on one connection.
    pub max_calls_per_connection: u32,
    /// Most open connections.
    pub max_connections: usize,
    /// Most requests of one `StreamKnn` evaluated at a time.
    pub stream_window: usize,
    /// Silence after which a connection is probed, in milliseconds; 0 for never.
    pub keepalive_interval_ms: u64,
    /// How long a probed connection may take to answer, in milliseconds.
    pub keepalive_timeout_ms: u64,
}

/// `[zenoh]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct ZenohConfig {
    /// The locator to listen on, as `tcp/host:port`, or [`ZenohConfig::OFF`].
    pub listen: String,
    /// With what every key begins.
    pub prefix: String,
    /// Most queries under way.
    pub max_calls: usize,
    /// The largest payload of a query in bytes.
    pub max_message_bytes: usize,
    /// What else Zenoh has to set, in JSON5.
    pub config: String,
}

impl ZenohConfig {
    /// In the place of a locator: there is no Zenoh face.
    pub const OFF: &str = "off";

    /// Whether there is no Zenoh face.
    pub(crate) fn is_off(&self) -> bool {
        self.listen == Self::OFF
    }
}

/// `[index]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct IndexConfig {
    /// The greatest number of points in the tree that grows; 0 to choose it by the space.
    pub growing_rows: usize,
    /// Points in a leaf.
    pub leaf_rows: usize,
    /// Merges at a time.
    pub merge_threads: usize,
    /// Bytes of recent mutations kept for each index.
    pub window_bytes: usize,
    /// For how long it keeps them, in seconds.
    pub window_seconds: u64,
}

impl IndexConfig {
    pub(crate) fn options(&self) -> RegistryOptions {
        RegistryOptions {
            growing_rows: (self.growing_rows > 0).then_some(self.growing_rows),
            leaf_rows: Some(self.leaf_rows),
            merge_threads: self.merge_threads,
            window_bytes: self.window_bytes,
            window: Duration::from_secs(self.window_seconds),
        }
    }
}

/// `[runtime]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct RuntimeConfig {
    /// Threads that answer calls; 0 for one a core.
    pub workers: usize,
}

/// `[shutdown]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct ShutdownConfig {
    /// How long accepted calls may take to finish, in milliseconds.
    pub grace_ms: u64,
}

/// `[log]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct LogConfig {
    /// Which lines are written.
    pub filter: String,
    /// In which form.
    pub format: LogFormat,
}

/// `[data]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct DataConfig {
    /// The directory to keep the indices in, or [`DataConfig::MEMORY`].
    pub dir: String,
    /// What an acknowledged mutation survives.
    pub durability: Durability,
}

impl DataConfig {
    /// In the place of a directory: the indices live in memory alone.
    pub const MEMORY: &str = "memory";

    /// The directory, if there is one.
    pub(crate) fn directory(&self) -> Option<&Path> {
        (self.dir != Self::MEMORY).then(|| Path::new(&self.dir))
    }
}

impl Config {
    /// The settings from all layers: the defaults, `file` if given, the `environment`, and `flags`, which are pairs of
    /// a key such as `grpc.listen` and its value.
    pub fn load(
        file: Option<&Path>,
        environment: &BTreeMap<String, String>,
        flags: &[(&str, String)],
    ) -> Result<Self, ConfigError> {
        layers::load(file, environment, flags)
    }
}

impl Default for Config {
    fn default() -> Self {
        layers::load(None, &BTreeMap::new(), &[]).expect("default.toml is whole")
    }
}
