//! The cost of planning with every source of neighbours: a single planner builds the same roadmap with each.

use super::{
    build::{self, Answer},
    options::Options,
    report::answers,
    scene::Rooms,
};
use crate::planning::{
    comparison::{self, Open, Trials},
    error::PlanningError,
    figures,
    options::{Source, seeds},
    prm_star::{self, AnsweredRoadmap},
    report::{self, can_write},
};

/// Compares the sources with the given options.
pub fn compare(scene: &Rooms, options: &Options) -> Result<(), PlanningError> {
    can_write(options.json.as_deref())?;
    let trials = Trials {
        sources: Source::All.sources(),
        seeds: seeds(options.seed, options.runs).collect(),
        server: options.server.as_deref(),
    };
    let tasks = scene.tasks().iter();
    let questions: Vec<_> = tasks
        .map(|task| [&task.start[..], &task.goal[..]])
        .collect();
    let milestones = usize::try_from(options.milestones).unwrap_or(usize::MAX);
    let plan = |own: &Open<'_>, seed| {
        let solved = prm_star::solve(scene, own()?, seed, milestones, &questions)?;
        check(scene, &solved)?;
        Ok(solved)
    };
    let comparison = comparison::compare(scene, &trials, plan)?;
    print!("{}", report::table(&comparison, None));
    let (solution, seed) = (&comparison.solution, options.seed);
    println!(
        "The roadmap of seed {seed} has {} milestones and {} edges with every source, and took {} collision checks.",
        solution.roadmap.len(),
        solution.roadmap.edge_count(),
        solution.account.checks,
    );
    print!("{}", answers(&check(scene, solution)?));
    figures::write(comparison.rows(), options.json.as_deref())
}

/// A path for each question, checked independently.
fn check(scene: &Rooms, solved: &AnsweredRoadmap) -> Result<Vec<Answer>, PlanningError> {
    let found = scene.tasks().iter().zip(&solved.paths);
    let milestones = solved.roadmap.len();
    found
        .map(|(task, path)| build::answer(scene, task, path.clone(), milestones))
        .collect()
}
