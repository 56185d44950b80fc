//! Charts over the time of the run.

use super::{
    axis::{self, Scale},
    svg::{BOTTOM, Chart, LEFT, RIGHT, TOP, legend},
};
use crate::load::{
    mix::Verb,
    outcome::{Outcome, Step, StepLatency},
    table::{Latency, rate_text},
};

type Quantile = fn(&StepLatency) -> u64;

/// p50, p99 and the slowest call of each step.
pub(super) fn latency(outcome: &Outcome) -> String {
    let latencies = outcome.steps.iter().filter_map(|step| step.latency);
    let low = latencies.clone().map(|latency| latency.p50).min();
    let high = latencies.map(|latency| latency.max).max();
    let (Some(low), Some(high)) = (low, high) else {
        return "<p class=\"none\">No call was answered.</p>\n".to_owned();
    };
    let mut chart = Chart::new("Latency over time: p50, p99 and the slowest call of each second");
    // The histograms begin at one nanosecond.
    let scale = Scale::logarithmic(low.max(1) as f64, high.max(1) as f64, BOTTOM, TOP);
    chart.rows(&scale, 5, |tick| Latency(tick.round() as u64).round());
    let times = time_axis(&mut chart, outcome);
    let series: [(&str, &str, Quantile); 3] = [
        ("max", "slowest", |latency| latency.max),
        ("p99", "p99", |latency| latency.p99),
        ("p50", "p50", |latency| latency.p50),
    ];
    for (class, _, of) in &series {
        for points in unbroken(outcome, |step| {
            let latency = step.latency?;
            Some([times.at(middle(step)), scale.at(of(&latency).max(1) as f64)])
        }) {
            chart.curve(class, &points);
        }
    }
    hovers(&mut chart, outcome, &times);
    let names = series.map(|(class, name, _)| (class, name));
    legend(&names) + &chart.end()
}

/// The answered calls of each verb, and the failed ones, in each step.
pub(super) fn throughput(outcome: &Outcome) -> String {
    let all = |step: &Step| step.answered.iter().sum::<u64>() + step.failed;
    let rates = outcome.steps.iter().map(|step| step.per_second(all(step)));
    let highest = rates.fold(0.0, f64::max);
    if highest == 0.0 {
        return "<p class=\"none\">No call was made.</p>\n".to_owned();
    }
    let mut chart = Chart::new("Answered calls per second by verb, and failed ones");
    let grain = axis::step(highest / 5.0);
    let scale = Scale::linear((highest / grain).ceil() * grain, BOTTOM, TOP);
    chart.rows(&scale, 5, rate_text);
    let mut names: Vec<(&str, &str)> = Vec::new();
    let mut below = vec![0.0; outcome.steps.len()];
    let times = Scale::linear(outcome.elapsed().as_secs_f64(), LEFT, RIGHT);
    let counts = Verb::ALL.map(|verb| {
        let of = move |step: &Step| step.answered[verb as usize];
        (verb.name(), Box::new(of) as Box<dyn Fn(&Step) -> u64>)
    });
    let failed: Box<dyn Fn(&Step) -> u64> = Box::new(|step| step.failed);
    for (name, count) in counts.into_iter().chain([("failed", failed)]) {
        if outcome.steps.iter().all(|step| count(step) == 0) {
            continue;
        }
        names.push((name, name));
        let (mut upper, mut lower) = (Vec::new(), Vec::new());
        for (step, below) in outcome.steps.iter().zip(&mut below) {
            let above = *below + step.per_second(count(step));
            for x in ends(step).map(|time| times.at(time)) {
                lower.push([x, scale.at(*below)]);
                upper.push([x, scale.at(above)]);
            }
            *below = above;
        }
        lower.reverse();
        upper.extend(lower);
        chart.area(name, &upper);
    }
    time_axis(&mut chart, outcome);
    hovers(&mut chart, outcome, &times);
    legend(&names) + &chart.end()
}

/// The axis of time, and the phases if there are several.
fn time_axis(chart: &mut Chart, outcome: &Outcome) -> Scale {
    let times = Scale::linear(outcome.elapsed().as_secs_f64(), LEFT, RIGHT);
    chart.columns(&times, 10, |seconds| match seconds {
        0.0 => "0 s".to_owned(),
        seconds => format!(
            "{} s",
            rate_text(seconds)
                .trim_end_matches('0')
                .trim_end_matches('.')
        ),
    });
    if outcome.phases.len() > 1 {
        for phase in &outcome.phases {
            let from = times.at(phase.start.as_secs_f64());
            chart.line("phase", [from, TOP - 14.0], [from, BOTTOM]);
            let to = times.at((phase.start + phase.elapsed).as_secs_f64());
            // A letter is about seven pixels wide.
            let letters = ((to - from - 8.0) / 7.0).max(0.0) as usize;
            let name = &phase.phase.name;
            let text = match name.chars().count() <= letters {
                true => name.clone(),
                false => name
                    .chars()
                    .take(letters.saturating_sub(1))
                    .chain(['…'])
                    .collect(),
            };
            if letters > 1 {
                chart.text("phase-name", from + 5.0, TOP - 5.0, &text);
            }
        }
    }
    times
}

fn ends(step: &Step) -> [f64; 2] {
    [step.start, step.start + step.width].map(|time| time.as_secs_f64())
}

fn middle(step: &Step) -> f64 {
    let [start, end] = ends(step);
    (start + end) / 2.0
}

/// The points of steps, in runs that steps without a point and the ends of phases break.
fn unbroken(outcome: &Outcome, point: impl Fn(&Step) -> Option<[f64; 2]>) -> Vec<Vec<[f64; 2]>> {
    let mut runs = vec![Vec::new()];
    let mut phase = None;
    for step in &outcome.steps {
        let point = point(step);
        if point.is_none() || phase != Some(step.phase) {
            runs.push(Vec::new());
        }
        phase = Some(step.phase);
        if let (Some(run), Some(point)) = (runs.last_mut(), point) {
            run.push(point);
        }
    }
    runs
}

/// All figures of a step under the pointer.
fn hovers(chart: &mut Chart, outcome: &Outcome, times: &Scale) {
    for step in &outcome.steps {
        let [start, end] = ends(step);
        let mut text = format!("{start:.1} to {end:.1} s");
        if let Some(latency) = step.latency {
            let [p50, p99, max] = [latency.p50, latency.p99, latency.max].map(Latency);
            text += &format!("\np50 {p50}, p99 {p99}, slowest {max}");
        }
        for (verb, answered) in Verb::ALL.into_iter().zip(step.answered) {
            if answered > 0 {
                text += &format!(
                    "\n{} {}/s",
                    verb.name(),
                    rate_text(step.per_second(answered))
                );
            }
        }
        if step.failed > 0 {
            text += &format!("\nfailed {}/s", rate_text(step.per_second(step.failed)));
        }
        chart.hover(times.at(start), times.at(end), &text);
    }
}
