//! The parts of the server that all faces use.

use std::net::SocketAddr;

use tokio::runtime::Handle;

use crate::{
    admission::Admission,
    config::{AdmissionConfig, Config, OFF},
    identity::Identities,
    observe::{Metrics, SlowCalls},
    service::{Error, Service},
    status::{Status, from_error},
};

/// The parts of the server that every face needs. Clones are cheap and share one state.
#[derive(Clone)]
pub(crate) struct FaceContext {
    pub(crate) service: Service,
    pub(crate) admission: Admission,
    pub(crate) slow_calls: SlowCalls,
    pub(crate) identities: Identities,
    pub(crate) metrics: Metrics,
}

impl FaceContext {
    /// The parts of a server with these settings, whose calls compute on the threads of this runtime.
    pub(crate) fn new(config: &Config, service: Service, identities: Identities) -> Self {
        let threads = Handle::current().metrics().num_workers();
        let message_bytes = config
            .grpc
            .max_message_bytes
            .max(config.zenoh.max_message_bytes);
        let admission = AdmissionConfig {
            max_bytes: config.max_call_bytes(),
            ..config.admission.clone()
        };
        Self {
            service,
            admission: Admission::new(&admission, threads, message_bytes),
            slow_calls: SlowCalls::new(config.log.slow_call_ms),
            identities,
            metrics: Metrics::new(config.http.listen != OFF),
        }
    }
}

/// The status of a call that made the server panic.
pub(crate) fn panicked(rpc: &str) -> Status {
    from_error(&Error::Internal {
        what: format!("{rpc} panicked"),
    })
}

/// The status of a call whose deadline passed.
pub(crate) fn deadline_exceeded() -> Status {
    from_error(&Error::DeadlineExceeded {
        doing: "before the call was done",
    })
}

/// The addresses that a server listens on.
#[derive(Clone)]
pub(crate) struct Addresses {
    pub(crate) grpc: SocketAddr,
    /// The pages for operators, if there are any.
    pub(crate) pages: Option<SocketAddr>,
    /// The listener for the other members of a cluster, if the server is in one.
    pub(crate) members: Option<SocketAddr>,
    /// True if gRPC speaks TLS.
    pub(crate) has_tls: bool,
    /// True if callers need an identity.
    pub(crate) has_identities: bool,
    /// Zenoh's locators; empty if Zenoh is off.
    pub(crate) zenoh: Vec<String>,
    /// A text for each address that strangers can use, which `--insecure` allows.
    pub(crate) warnings: Vec<String>,
}
