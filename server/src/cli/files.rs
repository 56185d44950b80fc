//! The limit of open files, which connections and the store share.

use crate::config::Config;
#[cfg(target_os = "linux")]
use crate::{http, zenoh};

/// The files that are no connections: the store keeps up to 900 open.
#[cfg(target_os = "linux")]
const OTHER_FILES: usize = 1_000;

/// Raises the limit as far as this process may: most systems set 1,024 and allow more, and a repair has two stores open.
/// Only Linux has it raised.
pub(super) fn raise_limit() {
    #[cfg(target_os = "linux")]
    {
        use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

        let limit = getrlimit(Resource::Nofile);
        let raised = Rlimit {
            current: limit.maximum,
            ..limit
        };
        if let Err(error) = setrlimit(Resource::Nofile, raised) {
            tracing::warn!(%error, "cannot raise the limit of open files");
        }
    }
}

/// Warns if the connections may reach the limit: no further one would be accepted then, and the store could open no file.
pub(super) fn check_limit(config: &Config) {
    #[cfg(target_os = "linux")]
    {
        use rustix::process::{Resource, getrlimit};

        let needed = needed(config);
        if let Some(limit) = getrlimit(Resource::Nofile).current
            && limit < needed
        {
            tracing::warn!(
                limit,
                needed,
                "the limit of open files is too low for the most connections: raise the hard limit (LimitNOFILE of \
                 systemd, --ulimit nofile of Docker), or lower grpc.max_connections"
            );
        }
    }
    #[cfg(not(target_os = "linux"))]
    let _ = config;
}

/// The files of a server with the most connections.
#[cfg(target_os = "linux")]
fn needed(config: &Config) -> u64 {
    let of_zenoh = match config.zenoh.is_off() {
        true => 0,
        false => zenoh::MAX_SESSIONS + zenoh::MAX_PENDING,
    };
    let others = of_zenoh + http::MAX_CONNECTIONS + OTHER_FILES;
    config.grpc.max_connections.saturating_add(others) as u64
}
