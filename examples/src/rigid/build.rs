//! One roadmap, from an empty index to the paths on it.

use std::time::{Duration, Instant};

use wayfold::{Client, IndexHandle, PayloadEncoding};

use super::{
    account::Account,
    options::{Job, Options, Source},
    roadmap::Roadmap,
    scene::{Rooms, Task},
    worker::Worker,
};
use crate::planning::{
    error::PlanningError,
    options::seeds,
    path,
    problem::Problem,
    processes::{self, Incident, WORKERS, WorkersReport},
    server::ServerProcess,
};

/// A roadmap, the accounts of its workers, and the answers to its questions.
pub struct Built {
    /// The number of processes that built it.
    pub workers: usize,
    /// The source of their neighbours.
    pub source: Source,
    /// The seed of the random states.
    pub seed: u64,
    /// The account of each worker.
    pub workers_report: WorkersReport<Account>,
    /// The number of milestones that a dead worker left pending.
    pub adopted: usize,
    /// The time to complete these.
    pub adopting: Duration,
    /// The whole roadmap, with the states of the questions.
    pub roadmap: Roadmap,
    /// The smallest distance between the workers' milestones, and the configured minimum, if there was one.
    pub separation: Option<(f64, f64)>,
    /// A path for each question.
    pub paths: Vec<Answer>,
    /// The time of these paths: connecting their ends with the roadmap, and searching it.
    pub asking: Duration,
}

/// The answer to a question.
pub struct Answer {
    /// The name of the question.
    pub name: &'static str,
    /// The path.
    pub states: Vec<Vec<f64>>,
    /// Its length in the metric.
    pub length: f64,
    /// The number of states at which it was checked independently.
    pub checked: usize,
}

/// Builds one roadmap with the given options, and answers all questions. `server` is the server at `uri` if it is to be
/// restarted meanwhile.
pub async fn build(
    scene: &Rooms,
    uri: &str,
    server: Option<&mut ServerProcess>,
    options: &Options,
    seed: u64,
) -> Result<Built, PlanningError> {
    let work = async |index: &IndexHandle| build_in(scene, uri, server, index, options, seed).await;
    in_new_index(scene, uri, options.keep, work).await
}

/// The result of `work` in an index of its own, which it leaves on the server only with `keep`.
pub async fn in_new_index<T>(
    scene: &Rooms,
    uri: &str,
    keep: bool,
    work: impl AsyncFnOnce(&IndexHandle) -> Result<T, PlanningError>,
) -> Result<T, PlanningError> {
    let client = Client::connect(uri).await?;
    let name = format!("rigid-{}", uuid::Uuid::new_v4());
    let index = client.create_index_with(&name, scene.space(), PayloadEncoding::Edges);
    let done = work(&index.await?).await;
    if !keep {
        // If the server is gone, its indices are gone too.
        let _ = client.delete_index(&name).await;
    }
    done
}

async fn build_in(
    scene: &Rooms,
    uri: &str,
    server: Option<&mut ServerProcess>,
    index: &IndexHandle,
    options: &Options,
    seed: u64,
) -> Result<Built, PlanningError> {
    let incident = match server {
        Some(server) if options.restart => Incident::ServerRestarted(server),
        _ if options.kill => Incident::WorkerKilled,
        _ => Incident::None,
    };
    let half = (options.kill || options.restart)
        .then_some(options.milestones / options.workers as u64 / 2);
    let job = |number| Job {
        halt_at: half.filter(|_| number == 0),
        ..options.job(uri, index.name(), number, seed)
    };
    let jobs: Vec<Job> = (0..options.workers).map(job).collect();
    let workers_report = processes::run(&jobs, incident)?;

    // The questions are asked by one more worker. Their states become milestones like all others, and stay for later
    // questions.
    let at = (uri, index.name());
    let mut last = Worker::open(scene, at, Source::Shared, options.workers, seed).await?;
    let start = Instant::now();
    let adopted = last.adopt(None).await?;
    let adopting = start.elapsed();

    let start = Instant::now();
    let mut ends = Vec::new();
    for task in scene.tasks() {
        let [start, goal] = [&task.start, &task.goal].map(Clone::clone);
        ends.push((last.add(start).await?, last.add(goal).await?));
    }
    let roadmap = Roadmap::read(index).await?;
    let separation = (options.min_separation > 0.0)
        .then(|| roadmap.separation(scene.space(), options.workers))
        .flatten();
    let mut found = Vec::new();
    for ends in ends {
        found.push(match ends {
            (Some(start), Some(goal)) => roadmap.path(scene.space(), start, goal),
            _ => None,
        });
    }
    let asking = start.elapsed();
    let mut paths = Vec::new();
    for (task, found) in scene.tasks().iter().zip(found) {
        paths.push(answer(scene, task, found, roadmap.len())?);
    }
    Ok(Built {
        workers: options.workers,
        source: options.source,
        seed,
        workers_report,
        adopted,
        adopting,
        roadmap,
        separation: separation.map(|found| (found, options.min_separation)),
        paths,
        asking,
    })
}

/// The path found for a question on a roadmap with the given number of milestones, checked independently.
pub fn answer(
    scene: &Rooms,
    task: &Task,
    found: Option<Vec<Vec<f64>>>,
    milestones: usize,
) -> Result<Answer, PlanningError> {
    let states = found.ok_or_else(|| PlanningError::Unconnected {
        task: task.name.to_owned(),
        milestones,
    })?;
    Ok(Answer {
        name: task.name,
        checked: path::verify(scene, &states)?,
        length: path::length(scene, &states),
        states,
    })
}

/// Builds roadmaps with all numbers of workers and both sources. The contestants take turns, so that other load on the
/// machine affects all of them.
pub async fn compare(
    scene: &Rooms,
    uri: &str,
    options: &Options,
) -> Result<Vec<Built>, PlanningError> {
    let mut all = Vec::new();
    for seed in seeds(options.seed, options.runs) {
        for workers in WORKERS {
            for source in [Source::Shared, Source::Remote] {
                eprintln!("{workers} workers, {}, seed {seed} ...", source.name());
                let options = Options {
                    workers,
                    source,
                    ..options.clone()
                };
                all.push(build(scene, uri, None, &options, seed).await?);
            }
        }
    }
    Ok(all)
}
