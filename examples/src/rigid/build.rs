//! One roadmap, from an empty index to the paths on it.

use std::time::{Duration, Instant};

use wayfold::{Client, IndexHandle};

use super::{
    account::Account,
    nearby::Source,
    options::{Job, Kind, Options},
    roadmap::{self, Roadmap},
    scene::{Rooms, Task},
    worker::Worker,
};
use crate::planning::{
    error::PlanningError,
    options::seeds,
    path,
    problem::Problem,
    processes::{self, Crew, Incident, PROGRESS_MS},
    server::ServerProcess,
};

/// A roadmap, what its workers did for it, and what it was asked.
pub struct Built {
    /// How many processes built it.
    pub workers: usize,
    /// Where their first neighbours came from.
    pub source: Kind,
    /// What the states were drawn from.
    pub seed: u64,
    /// What each did.
    pub crew: Crew<Account>,
    /// How many milestones a dead worker had left pending.
    pub adopted: usize,
    /// How long it took to complete these.
    pub adopting: Duration,
    /// All of it, with the states that were asked about.
    pub roadmap: Roadmap,
    /// How near the workers' milestones are to each other at least, and how near they were to be, if that was limited.
    pub separation: Option<(f64, f64)>,
    /// A path for each question.
    pub paths: Vec<Answer>,
    /// How long these took, to connect their ends with the roadmap and to search it.
    pub asking: Duration,
}

/// A path that was asked for.
pub struct Answer {
    /// From where to where.
    pub name: &'static str,
    /// The path.
    pub states: Vec<Vec<f64>>,
    /// Its length in the metric.
    pub length: f64,
    /// At how many states it was checked anew.
    pub checked: usize,
}

/// Builds one roadmap as the options say, and asks it all questions. If it is to be restarted meanwhile, `server` is the one
/// at `uri`.
pub async fn build(
    scene: &Rooms,
    uri: &str,
    server: Option<&mut ServerProcess>,
    options: &Options,
    seed: u64,
) -> Result<Built, PlanningError> {
    let client = Client::connect(uri).await?;
    let name = format!("rigid-{}", uuid::Uuid::new_v4());
    let index = client.create_index(&name, scene.space()).await?;
    let built = build_in(scene, uri, server, &index, options, seed).await;
    // What is left behind on a server that is gone, goes with it.
    let _ = client.delete_index(&name).await;
    built
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
        server: uri.to_owned(),
        index: index.name().to_owned(),
        number,
        seed,
        milestones: options.milestones,
        source: options.source,
        batch: options.batch,
        min_separation: options.min_separation,
        progress_ms: PROGRESS_MS,
        halt_at: half.filter(|_| number == 0),
    };
    let jobs: Vec<Job> = (0..options.workers).map(job).collect();
    let crew = processes::run(&jobs, incident)?;

    // Who asks is one more worker: its questions are milestones like all others, and stay for later ones.
    let mut last = Worker::new(scene, index.clone(), Source::Server, options.workers, seed);
    let start = Instant::now();
    // Up to the workers' last revision: what they told is behind what they did.
    index.info().await?;
    let adopted = roadmap::adopt(index, &mut last).await?;
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
        crew,
        adopted,
        adopting,
        roadmap,
        separation: separation.map(|found| (found, options.min_separation)),
        paths,
        asking,
    })
}

/// A path that was found for a question on a roadmap of so many milestones, checked anew.
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

/// How many workers are compared.
pub const WORKERS: [usize; 4] = [1, 2, 4, 8];

/// Builds roadmaps with all numbers of workers and both sources, in turns, so that what else the machine does meets all.
pub async fn compare(
    scene: &Rooms,
    uri: &str,
    options: &Options,
) -> Result<Vec<Built>, PlanningError> {
    let mut all = Vec::new();
    for seed in seeds(options.seed, options.runs) {
        for workers in WORKERS {
            for source in [Kind::Replica, Kind::Server] {
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
