//! The links of the face, as a metric.

use std::fmt;

use prometheus_client::{
    collector::Collector,
    encoding::{DescriptorEncoder, EncodeMetric},
    metrics::gauge::ConstGauge,
};
use zenoh::{Session, Wait};

/// Counts the routers and peers that a session is linked with, at each look.
#[derive(Debug)]
pub(super) struct Links(pub(super) Session);

impl Collector for Links {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let count = self.0.info().transports().wait().count();
        let gauge = ConstGauge::new(count as u64);
        let help = "The routers, peers and clients that Zenoh is linked with";
        let metric = encoder.encode_descriptor("zenoh_links", help, None, gauge.metric_type())?;
        gauge.encode(metric)
    }
}
