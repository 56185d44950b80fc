//! The links of the face: their metrics, and the log of those that it opens.

use std::{fmt, time::Duration};

use prometheus_client::{
    collector::Collector,
    encoding::{DescriptorEncoder, EncodeMetric},
    metrics::{counter::ConstCounter, gauge::ConstGauge},
};
use serde_json::json;
use tokio::time::{Instant, interval_at};
use tracing::{info, warn};
use zenoh::{Session, Wait, config::WhatAmI, internal::runtime::Runtime};

/// The interval of the checks for links to routers and peers.
const CHECK_INTERVAL: Duration = Duration::from_secs(2);

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

/// Logs when no router or peer of the `endpoints` is linked, and when one is again. Zenoh retries silently.
pub(super) async fn report_links(session: Session, endpoints: String) {
    let mut checks = interval_at(Instant::now() + CHECK_INTERVAL, CHECK_INTERVAL);
    let mut was_linked = None;
    loop {
        checks.tick().await;
        if session.is_closed() {
            return;
        }
        // Clients have connected to this server.
        let mut transports = session.info().transports().await;
        let is_linked = transports.any(|it| it.whatami() != WhatAmI::Client);
        match (was_linked.replace(is_linked), is_linked) {
            (None, false) => warn!(
                endpoints,
                "no Zenoh router or peer is reached yet, which is tried on: see connect in zenoh.config"
            ),
            (Some(true), false) => warn!(
                endpoints,
                "the last link to a Zenoh router or peer is gone; Zenoh tries to open one again"
            ),
            (Some(false), true) => info!(endpoints, "a Zenoh router or peer is reached"),
            _ => {}
        }
    }
}
