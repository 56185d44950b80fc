//! The parts of the server that both faces use.

use crate::{
    admission::Admission,
    identity::Identities,
    observe::{Metrics, SlowCalls},
    service::Service,
};

/// See the module. Clones share them.
#[derive(Clone)]
pub(crate) struct Shared {
    pub(crate) service: Service,
    pub(crate) admission: Admission,
    pub(crate) slow_calls: SlowCalls,
    pub(crate) identities: Identities,
    pub(crate) metrics: Metrics,
}
