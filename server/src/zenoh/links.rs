//! The links of the face: their metrics, and their end.

use std::{fmt, sync::mpsc, thread, time::Duration};

use prometheus_client::{
    collector::Collector,
    encoding::{DescriptorEncoder, EncodeMetric},
    metrics::{counter::ConstCounter, gauge::ConstGauge},
};
use serde_json::json;
use tracing::warn;
use zenoh::{Session, Wait, internal::runtime::Runtime};

/// A drop waits this long until the links are closed. Zenoh tells each peer, and waits for those that do not read, one
/// message after the other.
const CLOSE_WAIT: Duration = Duration::from_secs(1);

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

/// Measures the links of a session at each look.
#[derive(Debug)]
pub(super) struct Links {
    pub(super) session: Session,
    pub(super) runtime: Runtime,
}

impl Collector for Links {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let count = self.session.info().transports().wait().count();
        let gauge = ConstGauge::new(count as u64);
        let help = "The routers, peers and clients that Zenoh is linked with";
        let metric = encoder.encode_descriptor("zenoh_links", help, None, gauge.metric_type())?;
        gauge.encode(metric)?;
        let dropped = ConstCounter::new(dropped(&self.runtime));
        let help = "The messages that Zenoh dropped because their link was full";
        let kind = dropped.metric_type();
        let metric = encoder.encode_descriptor("zenoh_dropped", help, None, kind)?;
        dropped.encode(metric)
    }
}

/// The messages that were dropped because their link was full, of closed links too.
fn dropped(runtime: &Runtime) -> u64 {
    // Zenoh adds its counts to this form only.
    let mut state = json!({ "sessions": [] });
    runtime.stats().merge_stats(&mut state);
    state["stats"]["tx_n_dropped"].as_u64().unwrap_or_default()
}
