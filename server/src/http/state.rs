//! The figures that are measured at each look at `/metrics`.

use std::{fmt, sync::Arc};

use prometheus_client::{
    collector::Collector,
    encoding::{DescriptorEncoder, EncodeLabelSet, EncodeMetric},
    metrics::{MetricType, counter::ConstCounter, gauge::ConstGauge},
    registry::Unit,
};

use crate::{
    admission::Admission,
    lifecycle::{Phase, PhaseWatch},
    registry::Listed,
    service::Service,
    watermark::Level,
};

/// See the module.
pub(crate) struct State {
    pub(crate) service: Service,
    pub(crate) admission: Admission,
    pub(crate) phases: PhaseWatch,
}

impl fmt::Debug for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("State")
    }
}

/// The label of an index.
type Index = [(&'static str, Arc<str>); 1];

/// A gauge of every index: its name, its help, and its figures by index.
type OfIndices = (&'static str, &'static str, Vec<(Index, u64)>);

/// The gauges of an index, in the order of its figures.
const OF_INDEX: [(&str, &str); 8] = [
    ("index_points", "The points of an index"),
    ("index_revision", "The newest readable revision of an index"),
    ("index_memory_bytes", "About the memory of an index"),
    ("index_levels", "The trees of an index; merges reduce them"),
    (
        "index_records_in_flight",
        "Records that are submitted and not readable yet",
    ),
    ("index_sessions", "The writer sessions of an index"),
    (
        "index_followers",
        "The subscribers of an index: shared indices, watches, and publications over Zenoh",
    ),
    (
        "index_follower_lag",
        "The readable records that the last subscriber of an index does not have",
    ),
];

impl Collector for State {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let version = [("version", env!("CARGO_PKG_VERSION"))];
        gauges(
            &mut encoder,
            "build",
            "The version of the server",
            None,
            &[(version, 1)],
        )?;
        let is_serving = u64::from(self.phases.current() == Phase::Serving);
        let states = [
            ([("state", "reading")], is_serving),
            (
                [("state", "writing")],
                is_serving & u64::from(self.service.accepts_growth()),
            ),
        ];
        gauges(
            &mut encoder,
            "ready",
            "1 if calls that read, or add points, are answered",
            None,
            &states,
        )?;
        let help = "Merges of trees that run now; index.merge_threads is the most";
        gauges(
            &mut encoder,
            "merges",
            help,
            None,
            &[([("state", "running")], self.service.merges())],
        )?;
        self.admission(&mut encoder)?;
        self.resources(&mut encoder)?;
        for (name, help, figures) in self.indices() {
            gauges(&mut encoder, name, help, None, &figures)?;
        }
        Ok(())
    }
}

impl State {
    fn admission(&self, encoder: &mut DescriptorEncoder<'_>) -> fmt::Result {
        let (held, most) = self.admission.bytes();
        let bytes = [([("of", "held")], held), ([("of", "most")], most)];
        let help =
            "The bytes of requests, calls and unread answers, and the most that they may hold";
        gauges(encoder, "in_flight", help, Some(&Unit::Bytes), &bytes)?;
        let refused = self.admission.refused();
        let mut metric = encoder.encode_descriptor(
            "refused_calls",
            "Calls that were refused because the server was busy, by reason",
            None,
            MetricType::Counter,
        )?;
        for (reason, count) in refused {
            let labels = [("reason", reason)];
            let counter = ConstCounter::new(count);
            counter.encode(metric.encode_family(&labels)?)?;
        }
        Ok(())
    }

    fn resources(&self, encoder: &mut DescriptorEncoder<'_>) -> fmt::Result {
        let watermarks = self.service.watermarks();
        let mut figures = Vec::new();
        for (resource, level) in watermarks {
            let Level {
                used, high, limit, ..
            } = level;
            for (of, bytes) in [("used", used), ("high", high), ("limit", limit)] {
                figures.push(([("resource", resource), ("of", of)], bytes));
            }
        }
        let help = "Memory and disk: what is used, the high watermark, and what there is";
        gauges(encoder, "resource", help, Some(&Unit::Bytes), &figures)
    }

    fn indices(&self) -> Vec<OfIndices> {
        let gauges = OF_INDEX.map(|(name, help)| (name, help, Vec::new()));
        let mut gauges: Vec<OfIndices> = gauges.into();
        let (mut served, mut damaged) = (0, 0);
        for listed in self.service.listed() {
            let Listed::Hosted(hosted) = listed else {
                damaged += 1;
                continue;
            };
            served += 1;
            // One for all indices beyond the labelled ones would be wrong for each of them.
            let Some(label) = hosted.own_label() else {
                continue;
            };
            let published = hosted.published();
            let (followers, lag) = hosted.followers_and_lag();
            let figures = [
                published.snapshot.len() as u64,
                published.revision,
                published.snapshot.memory_bytes() as u64,
                published.snapshot.levels() as u64,
                hosted.records_in_flight() as u64,
                published.view.sessions().len() as u64,
                followers as u64,
                lag,
            ];
            for (gauge, figure) in gauges.iter_mut().zip(figures) {
                gauge.2.push(([("index", Arc::clone(label))], figure));
            }
        }
        let state = |state: &str| [("state", Arc::from(state))];
        gauges.push((
            "indices",
            "Indices that are served, and those that cannot be read",
            vec![(state("served"), served), (state("damaged"), damaged)],
        ));
        gauges
    }
}

fn gauges<L: EncodeLabelSet>(
    encoder: &mut DescriptorEncoder<'_>,
    name: &str,
    help: &str,
    unit: Option<&Unit>,
    figures: &[(L, u64)],
) -> fmt::Result {
    let mut metric = encoder.encode_descriptor(name, help, unit, MetricType::Gauge)?;
    for (labels, figure) in figures {
        let gauge = ConstGauge::new(*figure);
        gauge.encode(metric.encode_family(labels)?)?;
    }
    Ok(())
}
