//! The latency by the share of the calls that took at most as long.

use hdrhistogram::Histogram;

use super::{
    axis::Scale,
    svg::{BOTTOM, Chart, LEFT, RIGHT, TOP, legend},
};
use crate::load::{
    outcome::{Outcome, PhaseOutcome},
    record::Tally,
    table::Latency,
};

/// The most nines: beyond them a curve would rest on calls that hardly any run has.
const MAX_NINES: f64 = 6.0;

/// A curve: its class, its name and its latencies.
struct Series {
    class: String,
    name: String,
    latencies: Histogram<u64>,
}

/// A curve for each verb, or for each phase if there are several.
pub(super) fn chart(outcome: &Outcome) -> String {
    let all: Vec<Series> = match outcome.phases.as_slice() {
        [phase] => of_verbs(&phase.tally),
        phases => of_phases(phases),
    };
    let most = all.iter().map(|series| series.latencies.len()).max();
    let low = all.iter().map(|series| series.latencies.min()).min();
    let high = all.iter().map(|series| series.latencies.max()).max();
    let (Some(most), Some(low), Some(high)) = (most, low, high) else {
        return "<p class=\"none\">No call was answered.</p>\n".to_owned();
    };
    let mut chart = Chart::new("Latency distribution");
    let scale = Scale::logarithmic(low.max(1) as f64, high.max(1) as f64, BOTTOM, TOP);
    chart.rows(&scale, 5, |tick| Latency(tick.round() as u64).round());
    let nines = nines_of(most);
    // Each nine has the same width, and so does all up to the first.
    let shares = Scale::linear(nines, LEFT, RIGHT);
    chart.line("axis", [LEFT, BOTTOM], [RIGHT, BOTTOM]);
    for (share, name) in [
        (0.0, "0"),
        (0.5, "p50"),
        (0.9, "p90"),
        (0.99, "p99"),
        (0.999, "p99.9"),
        (0.9999, "p99.99"),
        (0.99999, "p99.999"),
        (0.999999, "p99.9999"),
    ] {
        if nines_at(share) <= nines + 1e-9 {
            let x = shares.at(nines_at(share));
            chart.line("axis", [x, BOTTOM], [x, BOTTOM + 5.0]);
            chart.line("grid", [x, TOP], [x, BOTTOM]);
            chart.text("tick middle", x, BOTTOM + 20.0, name);
        }
    }
    for series in &all {
        let points = points(&series.latencies, nines).into_iter();
        let places = points.map(|(nines, value)| [shares.at(nines), scale.at(value.max(1) as f64)]);
        chart.curve(&series.class, &places.collect::<Vec<_>>());
    }
    hovers(&mut chart, &all, &shares, nines);
    let names: Vec<(&str, &str)> = all
        .iter()
        .map(|series| (series.class.as_str(), series.name.as_str()))
        .collect();
    legend(&names) + &chart.end()
}

fn of_verbs(tally: &Tally) -> Vec<Series> {
    let series = tally.called().filter_map(|(verb, tally)| {
        Some(Series {
            class: verb.name().to_owned(),
            name: verb.name().to_owned(),
            latencies: tally.latencies()?.clone(),
        })
    });
    series.collect()
}

fn of_phases(phases: &[PhaseOutcome]) -> Vec<Series> {
    // The colours of the style.
    const CLASSES: usize = 6;
    let series = phases.iter().enumerate().filter_map(|(i, outcome)| {
        Some(Series {
            class: format!("s{}", i % CLASSES),
            name: outcome.phase.name.clone(),
            latencies: outcome.tally.total().latencies()?.clone(),
        })
    });
    series.collect()
}

/// The number of nines of a share: 0.9 has one, 0.99 two.
fn nines_at(share: f64) -> f64 {
    -(1.0 - share).log10()
}

/// The share with this number of nines.
fn share_at(nines: f64) -> f64 {
    1.0 - 10_f64.powf(-nines)
}

/// The nines that this number of calls can show: among 1,000 calls the slowest is above 99.9 %.
fn nines_of(calls: u64) -> f64 {
    (calls as f64).log10().clamp(1.0, MAX_NINES)
}

/// The curve of one verb: the nines and the latency, up to its slowest call.
fn points(latencies: &Histogram<u64>, nines: f64) -> Vec<(f64, u64)> {
    const STEPS_A_NINE: f64 = 40.0;
    let own = nines_of(latencies.len()).min(nines);
    let steps = (own * STEPS_A_NINE).ceil() as u32;
    let at = (0..=steps).map(|step| (f64::from(step) / STEPS_A_NINE).min(own));
    let mut points: Vec<(f64, u64)> = at
        .map(|nines| (nines, latencies.value_at_quantile(share_at(nines))))
        .collect();
    if (latencies.len() as f64) < 10_f64.powf(MAX_NINES) {
        points.push((own, latencies.max()));
    }
    points
}

/// The latencies of all curves under the pointer.
fn hovers(chart: &mut Chart, all: &[Series], shares: &Scale, nines: f64) {
    const COLUMNS_A_NINE: f64 = 10.0;
    let columns = (nines * COLUMNS_A_NINE).ceil() as u32;
    for column in 0..columns {
        let [from, to] = [column, column + 1].map(|end| f64::from(end) / COLUMNS_A_NINE);
        let share = share_at((from + to) / 2.0);
        let mut text = format!("{:.*} % of the calls", nines.ceil() as usize, 100.0 * share);
        for series in all {
            let latency = Latency(series.latencies.value_at_quantile(share));
            text += &format!("\n{} at most {latency}", series.name);
        }
        chart.hover(shares.at(from), shares.at(to), &text);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nines_and_shares_are_inverse() {
        for share in [0.0, 0.5, 0.9, 0.999] {
            assert!((share_at(nines_at(share)) - share).abs() < 1e-12);
        }
        assert!((nines_at(0.99) - 2.0).abs() < 1e-9);
        assert_eq!(
            (nines_of(1), nines_of(1_000), nines_of(u64::MAX)),
            (1.0, 3.0, MAX_NINES)
        );
    }

    #[test]
    fn a_curve_ends_at_the_slowest_call() {
        let mut latencies = Histogram::<u64>::new(3).unwrap();
        (1..=1000).for_each(|value| latencies += value);
        let points = points(&latencies, 4.0);
        assert_eq!(points.first().unwrap().1, 1);
        let (nines, slowest) = points.last().unwrap();
        assert!((nines - 3.0).abs() < 1e-9);
        assert_eq!(*slowest, 1000);
        assert!(points.windows(2).all(|pair| pair[0].1 <= pair[1].1));
    }
}
