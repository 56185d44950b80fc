//! Time to solution: workers extend the roadmap until it answers all questions, and then stop.
//!
//! The ends of the questions are its first milestones. The main process follows the growing roadmap and merges the
//! components that its edges connect. Once both ends of every question are in one component, it ends the workers and
//! searches the paths. Workers can be ended at any time: a pending milestone lacks edges, but all its edges are free.

use std::{
    collections::HashMap,
    fmt::Write,
    time::{Duration, Instant},
};

use petgraph::unionfind::UnionFind;
use tokio::sync::mpsc::{self, UnboundedReceiver};
use wayfold::{Include, IndexHandle, Watch, WatchEvent};

use super::{
    account::Account,
    build::in_new_index,
    milestone::{self, PENDING},
    options::{Job, Options, Source},
    roadmap::Roadmap,
    scene::Rooms,
    worker::Worker,
};
use crate::planning::{
    comparison::PlannerOutcome,
    error::PlanningError,
    figures::{self, RunRecord, RunTimes},
    options::seeds,
    path,
    prm_star::AnsweredRoadmap,
    problem::Problem,
    processes::{self, Line, WORKERS, WorkerEvent, lost},
    report::median,
};

/// A roadmap that answers all questions.
struct SolvedRoadmap {
    source: Source,
    workers: usize,
    seed: u64,
    /// The time from the first milestone to the last path.
    wall: Duration,
    /// The number of milestones.
    milestones: usize,
    /// The summed account of workers and questions; for a worker, its last report.
    account: Account,
    /// The lengths of the paths.
    lengths: Vec<f64>,
}

/// Solves all questions several times with the given number of workers (with `--scaling`: 1, 2, 4 and 8), and prints
/// the times.
pub async fn run(scene: &Rooms, uri: &str, options: &Options) -> Result<(), PlanningError> {
    let workers = match options.scaling {
        true => &WORKERS[..],
        false => &[options.workers],
    };
    let solve_anew = async |options: &Options, seed| {
        let work = async |index: &IndexHandle| solve(scene, uri, index, options, seed).await;
        in_new_index(scene, uri, false, work).await
    };
    // This run does not count: the first calls of a new server take longer.
    solve_anew(options, options.seed).await?;
    let mut all = Vec::new();
    // The contestants take turns, so that other load on the machine affects all of them.
    for seed in seeds(options.seed, options.runs) {
        for &workers in workers {
            let options = Options {
                workers,
                ..options.clone()
            };
            all.push(solve_anew(&options, seed).await?);
        }
    }
    print!("{}", table(&all, workers));
    figures::write(all.iter().map(SolvedRoadmap::row), options.json.as_deref())
}

async fn solve(
    scene: &Rooms,
    uri: &str,
    index: &IndexHandle,
    options: &Options,
    seed: u64,
) -> Result<SolvedRoadmap, PlanningError> {
    let watch = index.watch().after(index.revision_at(0));
    let mut watch = watch.include(Include::all()).await?;
    let (events, mut lines) = mpsc::unbounded_channel();
    let job = |number| Job {
        // Each worker reports every milestone, so that the cost of a solution is exact.
        progress_ms: 0,
        ..options.job(uri, index.name(), number, seed)
    };
    let jobs: Vec<Job> = (0..options.workers).map(job).collect();
    let mut workers = processes::start(&jobs, move |event| events.send(event).is_ok())?;

    let at = (uri, index.name());
    let mut asker = Worker::open(scene, at, Source::Shared, options.workers, seed).await?;
    let start = Instant::now();
    let mut ends = Vec::new();
    for task in scene.tasks() {
        let (from, to) = (task.start.clone(), task.goal.clone());
        match (asker.add(from).await?, asker.add(to).await?) {
            (Some(from), Some(to)) => ends.push((from, to)),
            _ => return Err(unconnected(task.name, ends.len())),
        }
    }
    for worker in &mut workers {
        worker.begin()?;
    }
    let mut accounts = vec![Account::default(); options.workers];
    let joined = follow(&mut watch, &mut lines, &mut accounts, &ends).await;
    // The workers end here, even after an error.
    drop(workers);
    joined?;
    let roadmap = Roadmap::read(index).await?;
    let mut paths = Vec::new();
    for (task, (from, to)) in scene.tasks().iter().zip(ends) {
        let found = roadmap.path(scene.space(), from, to);
        paths.push(found.ok_or_else(|| unconnected(task.name, roadmap.len()))?);
    }
    let wall = start.elapsed();

    // The reports that they sent before they ended.
    while let Some((number, line, _)) = lines.recv().await {
        note(&mut accounts, number, line);
    }
    for path in &paths {
        path::verify(scene, path)?;
    }
    Ok(SolvedRoadmap {
        source: options.source,
        workers: options.workers,
        seed,
        wall,
        milestones: roadmap.len(),
        account: accounts.into_iter().chain([asker.account()]).sum(),
        lengths: paths.iter().map(|path| path::length(scene, path)).collect(),
    })
}

/// Follows the roadmap until its edges connect these pairs of milestones, or all workers are done.
async fn follow(
    watch: &mut Watch,
    lines: &mut UnboundedReceiver<WorkerEvent<Account>>,
    accounts: &mut [Account],
    ends: &[(u64, u64)],
) -> Result<(), PlanningError> {
    let (mut parts, mut positions) = (UnionFind::<usize>::new(0), HashMap::new());
    let mut done = vec![false; accounts.len()];
    loop {
        tokio::select! {
            event = watch.next() => {
                let stored = match event? {
                    Some(WatchEvent::Mutation(mutation)) => mutation.stored,
                    // The server trimmed the next records before they were read, or the index is gone.
                    Some(WatchEvent::Reset(_)) | None => return Err(PlanningError::Unfollowed),
                };
                for point in stored.iter() {
                    let id = point.id;
                    let at = *positions.entry(id).or_insert_with(|| parts.new_set());
                    let edges = point.payload.and_then(|payload| milestone::edges(payload));
                    let edges = edges.ok_or(PlanningError::Payload { id })?;
                    // A pending milestone may have an edge that it will lose to a nearer neighbour.
                    let complete = point.tag & PENDING == 0;
                    for other in edges.into_iter().filter(|_| complete) {
                        // Edges lead to earlier milestones.
                        let other = positions.get(&other).ok_or(PlanningError::Payload { id })?;
                        parts.union(at, *other);
                    }
                }
                let connected = |(from, to): &(u64, u64)| match (positions.get(from), positions.get(to)) {
                    (Some(from), Some(to)) => parts.equiv(*from, *to),
                    _ => false,
                };
                if ends.iter().all(connected) {
                    return Ok(());
                }
            }
            Some((number, line, _)) = lines.recv() => {
                if line.is_none() && !done[number] {
                    return Err(lost(number, "it ended early; what it said is above"));
                }
                done[number] |= note(accounts, number, line);
                // No more edges will come. The search for paths decides whether they suffice.
                if done.iter().all(|done| *done) {
                    return Ok(());
                }
            }
        }
    }
}

/// Notes a message of a worker; returns true if the worker is done.
fn note(accounts: &mut [Account], number: usize, line: Option<Line<Account>>) -> bool {
    match line {
        Some(Line::Progress(account)) => accounts[number] = account,
        Some(Line::Done(account)) => {
            accounts[number] = account;
            return true;
        }
        Some(Line::Ready | Line::Halted(_)) | None => {}
    }
    false
}

/// The figures of all runs, one line for each number of workers.
fn table(all: &[SolvedRoadmap], workers: &[usize]) -> String {
    let mut text =
        "workers   time to solution (least .. most), s   milestones   collision checks\n"
            .to_owned();
    for &workers in workers {
        let of = |figure: fn(&SolvedRoadmap) -> f64| {
            let mut figures: Vec<f64> = all
                .iter()
                .filter(|one| one.workers == workers)
                .map(figure)
                .collect();
            figures.sort_by(f64::total_cmp);
            let at = |at: usize| figures.get(at).copied().unwrap_or(f64::NAN);
            [
                at(0),
                median(figures.iter().copied()),
                at(figures.len().saturating_sub(1)),
            ]
        };
        let [least, median, most] = of(|one| one.wall.as_secs_f64());
        let [_, milestones, _] = of(|one| one.milestones as f64);
        let [_, checks, _] = of(|one| one.account.checks as f64);
        let time = format!("{median:.3} ({least:.3} .. {most:.3})");
        let _ = writeln!(
            text,
            "{workers:>7}   {time:>36}   {milestones:>10.0}   {checks:>16.0}"
        );
    }
    text
}

impl SolvedRoadmap {
    fn row(&self) -> RunRecord {
        RunRecord {
            planner: AnsweredRoadmap::PLANNER,
            source: self.source.name(),
            workers: self.workers,
            seed: self.seed,
            nodes: self.milestones as u64,
            spent: RunTimes::by_workers(self.wall, self.wall, self.account.times),
            checks: self.account.checks,
            path_lengths: self.lengths.clone(),
        }
    }
}

fn unconnected(task: &str, milestones: usize) -> PlanningError {
    PlanningError::Unconnected {
        task: task.to_owned(),
        milestones,
    }
}
