//! The figures that are measured at each look at `/metrics`.

use std::{
    fmt,
    sync::{Arc, atomic::Ordering::Relaxed},
};

use prometheus_client::{
    collector::Collector,
    encoding::{DescriptorEncoder, EncodeLabelSet, EncodeMetric},
    metrics::{MetricType, counter::ConstCounter, gauge::ConstGauge},
    registry::Unit,
};

use crate::{
    faces::FaceContext,
    lifecycle::{Phase, PhaseWatch},
    registry::{IndexState, Registry, UsagePart},
    watermark::Usage,
};

/// See the module.
pub(crate) struct MetricsCollector {
    pub(crate) shared: FaceContext,
    pub(crate) phases: PhaseWatch,
}

impl fmt::Debug for MetricsCollector {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("MetricsCollector")
    }
}

/// The label of an index.
type Index = [(&'static str, Arc<str>); 1];

/// A gauge of every index: its name, its help, and its figures by index.
type OfIndices = (&'static str, &'static str, Vec<(Index, u64)>);

/// The gauges of an index, in the order of its figures.
const OF_INDEX: [(&str, &str); 15] = [
    ("index_points", "The points of an index"),
    ("index_revision", "The newest readable revision of an index"),
    ("index_memory_bytes", "About the memory of an index"),
    (
        "index_levels",
        "The levels of an index and its growing tree; merges reduce them",
    ),
    (
        "index_unmerged_points",
        "The points of levels that wait for a merge, or are being merged",
    ),
    (
        "index_merge_lag_seconds",
        "The time for which the first of these points have waited; 0 if there are none",
    ),
    (
        "index_records_in_flight",
        "Records that are submitted and not readable yet",
    ),
    ("index_sessions", "The writer sessions of an index"),
    (
        "index_batches",
        "The batches of writer sessions that are under way",
    ),
    (
        "index_subscribers",
        "The subscribers of an index over gRPC: shared indices and watches",
    ),
    (
        "index_subscriber_lag",
        "The readable records that the last subscriber of an index does not have",
    ),
    (
        "index_window_records",
        "The newest records of an index, which are kept for subscribers that fall behind",
    ),
    (
        "index_window_bytes",
        "The bytes of these records; index.window_bytes is the most",
    ),
    (
        "index_owned",
        "1 if this server evaluates the mutations of an index, 0 if another server of the cluster does",
    ),
    (
        "index_held_records",
        "Records in NATS that are outside of all windows and not forgotten, because a server does not store them; \
         at the owner of the index",
    ),
];

impl Collector for MetricsCollector {
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
            (
                [("state", "reading")],
                is_serving & u64::from(self.shared.service.accepts_reads()),
            ),
            (
                [("state", "writing")],
                is_serving & u64::from(self.shared.service.accepts_growth()),
            ),
        ];
        gauges(
            &mut encoder,
            "ready",
            "1 if calls that read, or add points, are answered",
            None,
            &states,
        )?;
        let merges = self.shared.service.opened().map_or(0, Registry::merges);
        let help = "Merges of trees that run now; index.merge_threads is the most";
        gauges(
            &mut encoder,
            "merges",
            help,
            None,
            &[([("state", "running")], merges)],
        )?;
        let help = "The live servers of the cluster that this one hears, itself among them";
        let members = [([("state", "live")], self.shared.service.members())];
        gauges(&mut encoder, "cluster_members", help, None, &members)?;
        self.admission(&mut encoder)?;
        self.resources(&mut encoder)?;
        let (of_indices, missed) = self.indices();
        for (name, help, figures) in of_indices {
            gauges(&mut encoder, name, help, None, &figures)?;
        }
        let help = "Records that subscribers over Zenoh read from the log because no publication brought them";
        counters(&mut encoder, "index_missed_records", help, &missed)
    }
}

impl MetricsCollector {
    fn admission(&self, encoder: &mut DescriptorEncoder<'_>) -> fmt::Result {
        let (held, most) = self.shared.admission.bytes();
        let bytes = [([("of", "held")], held), ([("of", "most")], most)];
        let help =
            "The bytes of requests, calls and unread answers, and the most that they may hold";
        gauges(encoder, "in_flight", help, Some(&Unit::Bytes), &bytes)?;
        let excess = self.shared.identities.excess();
        let busy = self.shared.admission.refused(excess);
        let of_growth = self.shared.service.opened().map(Registry::refused_growth);
        let refused = busy.into_iter().chain(of_growth.into_iter().flatten());
        let refused: Vec<_> = refused
            .map(|(reason, count)| ([("reason", reason)], count))
            .collect();
        let help = "Calls that were refused because the server was busy or full, by reason";
        counters(encoder, "refused_calls", help, &refused)
    }

    fn resources(&self, encoder: &mut DescriptorEncoder<'_>) -> fmt::Result {
        let registry = self.shared.service.opened();
        let mut figures = Vec::new();
        for (resource, level) in registry.into_iter().flat_map(Registry::levels) {
            let Usage {
                used, high, limit, ..
            } = level;
            for (of, bytes) in [("used", used), ("high", high), ("limit", limit)] {
                figures.push(([("resource", resource), ("of", of)], bytes));
            }
        }
        let help = "Memory and disk: what is used, the high watermark, and what there is";
        gauges(encoder, "resource", help, Some(&Unit::Bytes), &figures)?;
        let (memory, disk) = registry.map(Registry::usage).unwrap_or_default();
        let parts = |parts: Vec<UsagePart>| -> Vec<_> {
            let labelled = parts
                .into_iter()
                .map(|(part, bytes)| ([("part", part)], bytes));
            labelled.collect()
        };
        let help = "About the memory of all indices and of the store, by part";
        gauges(encoder, "memory", help, Some(&Unit::Bytes), &parts(memory))?;
        let help = "The disk of the data directory, by part";
        gauges(encoder, "disk", help, Some(&Unit::Bytes), &parts(disk))
    }

    /// The gauges of all indices, and the records that subscribers of each have missed.
    fn indices(&self) -> (Vec<OfIndices>, Vec<(Index, u64)>) {
        let gauges = OF_INDEX.map(|(name, help)| (name, help, Vec::new()));
        let mut gauges: Vec<OfIndices> = gauges.into();
        let (mut serving, mut damaged) = (0, 0);
        let mut missed = Vec::new();
        for (_, state) in self.shared.service.listed() {
            let IndexState::Hosted(hosted) = state else {
                damaged += 1;
                continue;
            };
            match hosted.problem() {
                Some(_) => damaged += 1,
                None => serving += 1,
            }
            // One for all indices beyond the labelled ones would be wrong for each of them.
            let Some(label) = hosted.own_label() else {
                continue;
            };
            missed.push(([("index", Arc::clone(label))], hosted.missed.load(Relaxed)));
            let published = hosted.published();
            let (subscribers, lag) = hosted.subscribers.count_and_lag(published.revision);
            let window = hosted.window();
            let figures = [
                published.snapshot.len() as u64,
                published.revision,
                published.snapshot.memory_bytes() as u64,
                published.snapshot.trees() as u64,
                published.snapshot.unpacked() as u64,
                published
                    .snapshot
                    .unpacked_since()
                    .map_or(0, |since| since.elapsed().as_secs()),
                hosted.records_in_flight() as u64,
                published.view.sessions().len() as u64,
                hosted.batches_under_way() as u64,
                subscribers as u64,
                lag,
                window.records,
                window.bytes,
                u64::from(self.shared.service.owns(hosted.uid_text())),
                hosted.held.load(Relaxed),
            ];
            for (gauge, figure) in gauges.iter_mut().zip(figures) {
                gauge.2.push(([("index", Arc::clone(label))], figure));
            }
        }
        let state = |state: &str| [("state", Arc::from(state))];
        gauges.push((
            "indices",
            "Indices that are served, and those that cannot be read or written",
            vec![(state("served"), serving), (state("damaged"), damaged)],
        ));
        (gauges, missed)
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

fn counters<L: EncodeLabelSet>(
    encoder: &mut DescriptorEncoder<'_>,
    name: &str,
    help: &str,
    figures: &[(L, u64)],
) -> fmt::Result {
    let mut metric = encoder.encode_descriptor(name, help, None, MetricType::Counter)?;
    for (labels, figure) in figures {
        let counter = ConstCounter::new(*figure);
        counter.encode(metric.encode_family(labels)?)?;
    }
    Ok(())
}
