//! A run: fills the index, lets workers call it phase by phase, and removes what they stored.

use std::{
    hash::{BuildHasher, RandomState},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
        mpsc,
    },
    thread,
    time::{Duration, Instant, SystemTime},
};

use indicatif::ProgressBar;
use tokio::sync::watch;

use super::{
    collector::{Collector, LAG},
    error::LoadError,
    machine::Machine,
    mix::Verb,
    outcome::{Outcome, PhaseOutcome, PointCounts, Step},
    record::Tally,
    settings::{Address, Phase},
    states::{Range, Sampler},
    target::{self, Target},
    worker::{Task, Worker, Workload},
};
use crate::failure::Failure;

/// Everything that is decided before the first call.
#[derive(Clone, Debug)]
pub(super) struct Plan {
    pub(super) index: String,
    pub(super) address: Address,
    pub(super) phases: Vec<Phase>,
    pub(super) warmup: Option<Duration>,
    pub(super) range: Range,
    pub(super) seed: u64,
    /// The points to store first; `None` to decide by the index.
    pub(super) fill: Option<u64>,
    pub(super) keep: bool,
    pub(super) timeout: Duration,
    /// The tag of the points that the run stores.
    pub(super) tag: u64,
    /// Set once the server has answered all that a run asks first. Before, it has nothing to remove and no figures.
    pub(super) has_begun: Arc<AtomicBool>,
    /// Set once points may be stored that the run has to remove.
    pub(super) may_leave: Arc<AtomicBool>,
}

impl Plan {
    /// Notes that points may be stored from now on.
    fn begin_to_store(&self) {
        self.may_leave.store(!self.keep, Relaxed);
    }
}

/// A tag that no other run has.
pub(super) fn fresh_tag() -> u64 {
    // Each state of the standard library's hash maps has random keys.
    RandomState::new().hash_one("wayfold load")
}

/// Runs a plan on this thread until its end, or until `stopped`. Returns its outcome, and whether its points are removed.
pub(super) fn run(
    plan: Plan,
    stopped: watch::Receiver<bool>,
    line: &ProgressBar,
) -> Result<(Outcome, Result<(), Failure>), Failure> {
    let mut first = target::open(&plan.address, &plan.index, plan.timeout)?;
    let space = first.space();
    let before = first.point_count()?;
    let mut outcome = Outcome {
        index: plan.index.clone(),
        space: space.to_string(),
        address: plan.address.clone(),
        server: first.server()?,
        machine: Machine::current(),
        started: SystemTime::now(),
        seed: plan.seed,
        range: plan.range,
        timeout: plan.timeout,
        tag: plan.tag,
        warmup: None,
        phases: Vec::new(),
        steps: Vec::new(),
        points: PointCounts {
            before,
            are_kept: plan.keep,
            ..PointCounts::default()
        },
        flush: Duration::ZERO,
        is_interrupted: false,
    };
    let sampler = Sampler::new(&space, plan.range, plan.seed);
    plan.has_begun.store(true, Relaxed);
    let filled = fill(
        &plan,
        &sampler,
        first.as_mut(),
        &mut outcome.points,
        &stopped,
        line,
    );
    let measured =
        filled.and_then(|()| measure(&plan, sampler, first.as_mut(), &stopped, line, &mut outcome));
    outcome.is_interrupted = *stopped.borrow();
    line.set_message("settling");
    drop(first);
    let has_nothing = !plan.keep && !plan.may_leave.load(Relaxed);
    let cleaned = match outcome.is_interrupted && has_nothing {
        true => Ok(()),
        false => clean(&plan, &mut outcome.points),
    };
    if let Err(failure) = measured {
        // Points that are left behind matter more than the reason for which the run ended.
        cleaned?;
        return Err(failure);
    }
    Ok((outcome, cleaned))
}

/// Stores points before the run, and counts them.
fn fill(
    plan: &Plan,
    sampler: &Sampler,
    target: &mut dyn Target,
    points: &mut PointCounts,
    stopped: &watch::Receiver<bool>,
    line: &ProgressBar,
) -> Result<(), Failure> {
    const ROWS: u64 = 1_000;
    const IF_EMPTY: u64 = 1_000;
    let reads = |phase: &Phase| Verb::ALL[1..].iter().any(|verb| phase.mix.has(*verb));
    let is_wanted = points.before == 0 && plan.phases.iter().any(reads);
    let count = plan.fill.unwrap_or(if is_wanted { IF_EMPTY } else { 0 });
    let mut rng = sampler.stream(FILL_STREAM);
    while points.filled < count && !*stopped.borrow() {
        line.set_message(format!("storing {count} points: {}", points.filled));
        let rows = ROWS.min(count - points.filled);
        let states = sampler.rows(&mut rng, rows as usize);
        plan.begin_to_store();
        target.store(&states, plan.tag)?;
        points.filled += rows;
    }
    Ok(())
}

/// The random numbers of the points stored first, and of the probes of the radius; no call has these.
const FILL_STREAM: u64 = u64::MAX;
const PROBE_STREAM: u64 = u64::MAX - 1;

fn measure(
    plan: &Plan,
    sampler: Sampler,
    first: &mut dyn Target,
    stopped: &watch::Receiver<bool>,
    line: &ProgressBar,
    outcome: &mut Outcome,
) -> Result<(), Failure> {
    let phases = with_radius(&plan.phases, &sampler, first)?;
    let ids = match phases.iter().any(|phase| phase.mix.has(Verb::Get)) {
        true => first.ids(MAX_IDS)?,
        false => Vec::new(),
    };
    if ids.is_empty() && phases.iter().any(|phase| phase.mix.has(Verb::Get)) {
        let index = plan.index.clone();
        return Err(LoadError::NothingToGet { index }.into());
    }
    let workload = Arc::new(Workload {
        sampler,
        tag: plan.tag,
        ids,
    });
    let most = phases.iter().map(|phase| phase.workers).max().unwrap_or(1);
    let mut workers = Vec::with_capacity(most);
    for number in 0..most {
        line.set_message(format!("opening {most} workers: {number}"));
        workers.push(Worker {
            number,
            target: target::open(&plan.address, &plan.index, plan.timeout)?,
            stopped: stopped.clone(),
        });
    }
    if phases.iter().any(|phase| phase.mix.has(Verb::Insert)) {
        plan.begin_to_store();
    }
    let mut runner = Runner {
        workers,
        workload,
        step: step_width(&phases),
        line,
        outcome,
    };
    let done = runner.all(&phases, plan.warmup);
    runner.settle();
    done
}

/// The ids that `get` reads are some of the first of the index.
const MAX_IDS: usize = 100_000;

/// The phases with the radius of each. The default is the median distance of the k-th neighbour of some states.
fn with_radius(
    phases: &[Phase],
    sampler: &Sampler,
    target: &dyn Target,
) -> Result<Vec<Phase>, Failure> {
    const PROBES: usize = 32;
    let mut phases = phases.to_vec();
    for phase in &mut phases {
        if phase.radius.is_none() && phase.mix.has(Verb::Query) {
            let rows = sampler.rows(&mut sampler.stream(PROBE_STREAM), PROBES);
            let found = target.neighbors(&rows, phase.k)?;
            let farthest = found.iter().filter_map(|row| row.last());
            let mut distances: Vec<f64> = farthest.map(|neighbor| neighbor.distance).collect();
            distances.sort_by(f64::total_cmp);
            phase.radius = distances.get(distances.len() / 2).copied();
        }
    }
    Ok(phases)
}

/// A second; longer in a run of more than ten minutes, whose charts would have more points than pixels.
fn step_width(phases: &[Phase]) -> Duration {
    const STEPS: u32 = 600;
    let time: Duration = phases.iter().filter_map(|phase| phase.duration).sum();
    (time / STEPS).max(Duration::from_secs(1))
}

/// The workers, and what they have done.
struct Runner<'a> {
    workers: Vec<Worker>,
    workload: Arc<Workload>,
    step: Duration,
    line: &'a ProgressBar,
    outcome: &'a mut Outcome,
}

impl Runner<'_> {
    fn all(&mut self, phases: &[Phase], warmup: Option<Duration>) -> Result<(), Failure> {
        if let (Some(time), Some(phase)) = (warmup, phases.first()) {
            let warm = Phase {
                name: "warm-up".to_owned(),
                duration: Some(time),
                calls: None,
                ..phase.clone()
            };
            let (mut tally, mut steps) = (Tally::default(), Vec::new());
            let task = self.task(&warm, 0);
            let done = self.phase(&task, &mut tally, &mut steps);
            self.count(&tally);
            self.outcome.warmup = Some((task.elapsed(false), tally));
            done?;
        }
        for (number, phase) in phases.iter().enumerate() {
            // A signal ends the run after the phase that it hits.
            if self.is_stopped() {
                break;
            }
            let mut tally = Tally::default();
            let task = self.task(phase, number + 1);
            let mut steps = std::mem::take(&mut self.outcome.steps);
            let done = self.phase(&task, &mut tally, &mut steps);
            self.outcome.steps = steps;
            self.count(&tally);
            let is_cut = self.is_stopped();
            let elapsed = task.elapsed(is_cut);
            let due_until = if is_cut { elapsed } else { Duration::MAX };
            self.outcome.phases.push(PhaseOutcome {
                phase: phase.clone(),
                tally,
                start: self.outcome.elapsed(),
                elapsed,
                due: task.schedule.due_by(due_until),
            });
            done?;
        }
        Ok(())
    }

    fn is_stopped(&self) -> bool {
        self.workers.iter().any(|worker| *worker.stopped.borrow())
    }

    /// Counts the points that a phase stored.
    fn count(&mut self, tally: &Tally) {
        self.outcome.points.inserted += tally.of(Verb::Insert).rows;
    }

    fn task(&self, phase: &Phase, number: usize) -> Task {
        let workload = Arc::clone(&self.workload);
        Task::new(workload, phase.clone(), number as u64, self.step)
    }

    /// Lets the workers of a phase work, and collects what they record.
    fn phase(
        &mut self,
        task: &Task,
        tally: &mut Tally,
        steps: &mut Vec<Step>,
    ) -> Result<(), Failure> {
        let number = self.outcome.phases.len();
        let mut collector = Collector {
            task,
            phase: number,
            offset: self.outcome.elapsed(),
            width: self.step,
            tally,
            first: steps.len(),
            steps,
            line: self.line,
        };
        let step = self.step;
        let workers = &mut self.workers[..task.phase.workers];
        thread::scope(|scope| {
            // The channel is closed once every worker has ended.
            let (working, ended) = mpsc::channel::<()>();
            for worker in workers {
                let working = working.clone();
                let spawned = thread::Builder::new()
                    .name(format!("load-{}", worker.number))
                    .spawn_scoped(scope, move || {
                        worker.run(task);
                        drop(working);
                    });
                if let Err(source) = spawned {
                    task.schedule.end();
                    return Err(LoadError::Thread { source }.into());
                }
            }
            drop(working);
            // A call is recorded a little after it has ended.
            let mut next = step + LAG;
            loop {
                let wait = (task.began + next).saturating_duration_since(Instant::now());
                if let Err(mpsc::RecvTimeoutError::Disconnected) = ended.recv_timeout(wait) {
                    collector.last();
                    return Ok(());
                }
                collector.collect(task.began.elapsed().saturating_sub(LAG));
                next += step;
            }
        })
    }

    /// Closes the workers' targets.
    fn settle(&mut self) {
        let began = Instant::now();
        for worker in &mut self.workers {
            self.outcome.points.unsent += worker.target.settle();
        }
        self.outcome.flush = began.elapsed();
    }
}

/// Removes the points of the run, unless they are to stay, and counts what the index holds then. A count that cannot be had
/// is left out.
fn clean(plan: &Plan, points: &mut PointCounts) -> Result<(), Failure> {
    let removes = plan.may_leave.load(Relaxed);
    // A shared index of its own reads what all others wrote.
    let mut clean = || {
        let mut target = target::open(&plan.address, &plan.index, plan.timeout)?;
        if removes {
            points.removed = target.remove_tagged(plan.tag)?;
        }
        points.after = target.point_count().ok();
        target.settle();
        Ok(())
    };
    match clean() {
        Err(failure) if removes => Err(Failure::Load(LoadError::Left {
            index: plan.index.clone(),
            tag: plan.tag,
            problem: Failure::to_string(&failure),
        })),
        _ => Ok(()),
    }
}
