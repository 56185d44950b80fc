//! Timing in turns: every structure once, then every structure again, and the median of all rounds, so that other load
//! on the machine affects all of them alike.

use std::hint::black_box;
use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};
use wayfold_index::Space;

use crate::{
    check::{Case, NEIGHBORS},
    data::Rows,
    problem::Problem,
    report::{Op, Report},
    structures::{Kind, Structure, heap_bytes},
};

/// The minimum duration of one timing of queries.
const WINDOW: Duration = Duration::from_millis(50);
/// The minimum number of queries in one timing.
const MIN_QUERIES: usize = 20;

/// The extent of the measurements of a case.
#[derive(Clone, Copy, Debug)]
pub struct Effort {
    /// The number of repetitions of each timing.
    pub rounds: usize,
    /// The measured searches.
    pub searches: &'static [Op],
    /// The maximum number of builds and growths.
    pub growth_rounds: usize,
    /// A random tree that would take longer than this is left out.
    pub longest_rrt: Duration,
}

/// The maximum build time of a structure that is built repeatedly; a slower one is built once.
const MAX_REPEATED_BUILD: Duration = Duration::from_secs(5);

/// A measured structure.
struct MeasuredStructure {
    kind: Kind,
    /// The time to build or grow it.
    made: Duration,
    /// The time of a search for the nearest.
    nearest: Duration,
}

/// Measures those of these structures that accept the space.
///
/// # Errors
/// A structure does not equal brute force.
pub fn measure(
    case: &Case<'_>,
    kinds: &[Kind],
    effort: Effort,
    report: &mut Report,
) -> Result<(), Problem> {
    let mut measured = Vec::new();
    let mut structures: Vec<(Kind, Box<dyn Structure>)> = Vec::new();
    for &kind in kinds {
        if let Some(reason) = kind.refuses(case.space) {
            report.refused(kind, case.name, reason);
            continue;
        }
        let before = heap_bytes();
        let begin = processor_time();
        let mut structure = kind.of(case.space, case.points);
        let made = processor_time() - begin;
        let held = heap_bytes().saturating_sub(before);
        case.check(kind, structure.as_mut())?;
        report.add(
            case,
            kind,
            Op::Memory,
            held as f64 / case.points.len() as f64,
        );
        structures.push((kind, structure));
        measured.push(MeasuredStructure {
            kind,
            made,
            nearest: Duration::MAX,
        });
    }
    for &op in effort.searches {
        let takes = time_queries(case, op, effort.rounds, &mut structures);
        for (measured, takes) in measured.iter_mut().zip(takes) {
            report.add(case, measured.kind, op, takes.as_secs_f64() * 1e6);
            if op == Op::Knn1 {
                measured.nearest = takes;
            }
        }
    }
    drop(structures);
    time_growth(case, &measured, effort, report);
    Ok(())
}

/// The time of one query of each structure.
fn time_queries(
    case: &Case<'_>,
    op: Op,
    rounds: usize,
    structures: &mut [(Kind, Box<dyn Structure>)],
) -> Vec<Duration> {
    let counts: Vec<usize> = structures
        .iter_mut()
        .map(|(_, structure)| {
            // The count grows until caches are warm and the cost of a first call is negligible.
            let mut count = MIN_QUERIES;
            loop {
                let one = ask(case, op, structure.as_mut(), 0, count).as_secs_f64();
                let fit = (WINDOW.as_secs_f64() / one).ceil() as usize;
                if fit <= 4 * count {
                    break fit.max(MIN_QUERIES);
                }
                count *= 4;
            }
        })
        .collect();
    let mut times = vec![Vec::new(); structures.len()];
    for round in 0..rounds {
        for (at, (_, structure)) in structures.iter_mut().enumerate() {
            let count = counts[at];
            times[at].push(ask(case, op, structure.as_mut(), round * count, count));
        }
    }
    times.into_iter().map(median).collect()
}

/// The average time of each of `count` queries, from the `first` on.
fn ask(
    case: &Case<'_>,
    op: Op,
    structure: &mut dyn Structure,
    first: usize,
    count: usize,
) -> Duration {
    let queries = case.queries;
    let mut found = Vec::with_capacity(4 * NEIGHBORS);
    let mut at = first % queries.len();
    let begin = processor_time();
    for _ in 0..count {
        let query = queries.row(at);
        match op {
            Op::Knn1 => structure.nearest(query, 1, &mut found),
            Op::Knn10 => structure.nearest(query, NEIGHBORS, &mut found),
            _ => structure.within(query, case.radius, &mut found),
        }
        black_box(&found);
        at += 1;
        if at == queries.len() {
            at = 0;
        }
    }
    (processor_time() - begin) / count as u32
}

/// Times building, growing, and searching while growing.
fn time_growth(
    case: &Case<'_>,
    measured: &[MeasuredStructure],
    effort: Effort,
    report: &mut Report,
) {
    let n = case.points.len();
    let mut times = vec![[const { Vec::new() }; 3]; measured.len()];
    for round in 0..effort.growth_rounds {
        for (one, [build, insert, rrt]) in measured.iter().zip(&mut times) {
            let (kind, is_first) = (one.kind, round == 0);
            if is_first && kind.builds() && !kind.grows() {
                build.push(one.made);
            } else if kind.builds() && (is_first || one.made < MAX_REPEATED_BUILD) {
                let begin = processor_time();
                black_box(kind.built(case.space, case.points));
                build.push(processor_time() - begin);
            }
            if is_first && kind.grows() {
                insert.push(one.made);
            } else if kind.grows() && one.made < MAX_REPEATED_BUILD {
                insert.push(grow(kind, case.space, case.points, false));
            }
            // The average search finds half of all points stored.
            if kind.grows() && one.nearest.saturating_mul(n as u32 / 2) <= effort.longest_rrt {
                rrt.push(grow(kind, case.space, case.points, true));
            }
        }
    }
    let a_point = |time: Duration| time.as_secs_f64() * 1e9 / n as f64;
    for (one, [build, insert, rrt]) in measured.iter().zip(times) {
        if !build.is_empty() {
            report.add(case, one.kind, Op::Build, a_point(median(build)));
        }
        if !insert.is_empty() && !one.kind.appends() {
            report.add(case, one.kind, Op::Insert, a_point(median(insert)));
        }
        if !rrt.is_empty() {
            report.add(case, one.kind, Op::Rrt, median(rrt).as_secs_f64() * 1e3);
        }
    }
}

/// Inserts all rows one by one. To simulate a random tree, it first searches the nearest neighbour of each row.
fn grow(kind: Kind, space: &Space, rows: &Rows, is_asked: bool) -> Duration {
    let mut found = Vec::with_capacity(NEIGHBORS);
    let begin = processor_time();
    let mut structure = kind.empty(space, rows.len());
    for (at, row) in rows.iter().enumerate() {
        if is_asked && at > 0 {
            structure.nearest(row, 1, &mut found);
            black_box(&found);
        }
        structure.insert(row);
    }
    let taken = processor_time() - begin;
    black_box(structure);
    taken
}

/// The time that this thread has spent on a processor. It excludes other programs on a shared machine.
fn processor_time() -> Duration {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
}

fn median(mut times: Vec<Duration>) -> Duration {
    times.sort_unstable();
    times[times.len() / 2]
}
