//! PRM*: one roadmap for several questions, whose paths become shorter with every milestone.
//!
//! S. Karaman, E. Frazzoli, "Sampling-based algorithms for optimal motion planning", IJRR 30(7), 2011: PRM* in its
//! k-nearest form. The published algorithm draws all n milestones first. Here they are added one by one, and each tries
//! the motions to its k(n) nearest among the n earlier ones, as the workers of `rigid` do together. This is a single
//! planner, so that a comparison of sources differs in nothing else.

use std::{
    collections::HashMap,
    time::{Duration, Instant},
};

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use wayfold::{Scaling, States};

use super::{
    account::{Account, Growth, Record},
    comparison::PlannerOutcome,
    error::PlanningError,
    path,
    problem::Problem,
    sampling,
    source::TimedIndex,
};

/// k(n): the paper's 2e · ln n, above its bound e(1 + 1/d) · ln n in every dimension above 1.
pub fn k(milestones: usize) -> usize {
    let scaling = Scaling {
        k_factor: Some(Scaling::K_FACTOR),
        ..Scaling::default()
    };
    scaling.k(milestones).unwrap_or(usize::MAX)
}

/// The maximum number of states drawn for each milestone, so that sampling ends if no state is free.
const MAX_DRAWS: usize = 100;

/// The milestones, numbered from 0, and their edges.
#[derive(Clone, Debug, PartialEq)]
pub struct Roadmap {
    /// The milestones' states.
    pub states: States,
    /// The edges of each milestone to earlier ones, ascending.
    pub edges: Vec<Vec<usize>>,
}

impl Roadmap {
    /// The number of milestones.
    pub fn len(&self) -> usize {
        self.edges.len()
    }

    /// The number of edges.
    pub fn edge_count(&self) -> usize {
        self.edges.iter().map(Vec::len).sum()
    }
}

/// A roadmap, and the answers to its questions.
pub struct AnsweredRoadmap {
    /// All milestones; those of the questions are last.
    pub roadmap: Roadmap,
    /// The shortest path on it for each question; None if it does not connect start and goal.
    pub paths: Vec<Option<Vec<Vec<f64>>>>,
    /// The account of the time up to the last path.
    pub account: Account,
    /// The history of the account, in steps of about the same number of milestones.
    pub growth: Vec<Growth>,
}

impl PlannerOutcome for AnsweredRoadmap {
    const PLANNER: &'static str = "PRM*";
    const INSERT: &'static str = "a milestone";

    fn nodes(&self) -> usize {
        self.roadmap.len()
    }

    fn account(&self) -> Account {
        self.account
    }

    fn growth(&self) -> &[Growth] {
        &self.growth
    }

    fn paths(&self) -> impl Iterator<Item = &[Vec<f64>]> {
        self.paths.iter().flatten().map(Vec::as_slice)
    }

    fn is_like(&self, other: &AnsweredRoadmap) -> bool {
        self.roadmap == other.roadmap
    }
}

/// Builds a roadmap of the given number of milestones, adds the starts and goals of all questions, and answers the
/// questions. The same seed builds the same roadmap with any exact source.
pub fn solve(
    problem: &impl Problem,
    index: TimedIndex,
    seed: u64,
    milestones: usize,
    questions: &[[&[f64]; 2]],
) -> Result<AnsweredRoadmap, PlanningError> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut planner = Planner::new(problem, index);
    for _ in 0..MAX_DRAWS.saturating_mul(milestones) {
        if planner.roadmap.len() == milestones {
            break;
        }
        let random = sampling::uniform(problem.space(), problem.bounds(), &mut rng);
        if planner.is_free(&random) {
            planner.add(&random)?;
            planner.note();
        }
    }
    let mut ends = Vec::with_capacity(questions.len());
    for [start, goal] in questions {
        ends.push([planner.add(start)?, planner.add(goal)?]);
    }
    planner.answer(&ends)
}

struct Planner<'a, P> {
    problem: &'a P,
    index: TimedIndex,
    roadmap: Roadmap,
    /// The milestones by their ids in the index.
    milestones: HashMap<u64, usize>,
    started: Instant,
    checking: Duration,
    checks: u64,
    record: Record,
}

impl<'a, P: Problem> Planner<'a, P> {
    fn new(problem: &'a P, index: TimedIndex) -> Self {
        Planner {
            problem,
            index,
            roadmap: Roadmap {
                states: States::new(problem.space().coordinates()),
                edges: Vec::new(),
            },
            milestones: HashMap::new(),
            started: Instant::now(),
            checking: Duration::ZERO,
            checks: 0,
            record: Record::new(),
        }
    }

    fn is_free(&mut self, state: &[f64]) -> bool {
        let start = Instant::now();
        let free = self.problem.is_free(state);
        self.checking += start.elapsed();
        self.checks += 1;
        free
    }

    /// Makes a free state a milestone with all its edges, and returns its number.
    fn add(&mut self, state: &[f64]) -> Result<usize, PlanningError> {
        let milestone = self.roadmap.len();
        // k(n) is evaluated here, because no other client inserts. So all sources answer the same plain search.
        let found = self.index.nearest_k(state, k(milestone))?;
        let start = Instant::now();
        let near = found.iter().map(|near| self.milestones[&near.id]);
        let (problem, checks) = (self.problem, &mut self.checks);
        let states = &self.roadmap.states;
        let free = near.filter(|&other| problem.is_free_way(state, states.row(other), checks));
        let mut edges: Vec<usize> = free.collect();
        edges.sort_unstable();
        self.checking += start.elapsed();
        let mut inserted = States::new(state.len());
        inserted.push(state)?;
        let ids = self.index.insert(&inserted)?;
        self.milestones
            .extend(ids.iter().map(|&id| (id, milestone)));
        self.roadmap.states.push(state)?;
        self.roadmap.edges.push(edges);
        Ok(milestone)
    }

    fn account(&self) -> Account {
        Account {
            total: self.started.elapsed(),
            neighbors: self.index.usage(),
            checking: self.checking,
            checks: self.checks as usize,
            flushing: Duration::ZERO,
        }
    }

    fn note(&mut self) {
        let milestones = self.roadmap.len();
        if self.record.is_due(milestones) {
            let account = self.account();
            self.record.note(milestones, account);
        }
    }

    /// The shortest paths between these milestones.
    fn answer(self, ends: &[[usize; 2]]) -> Result<AnsweredRoadmap, PlanningError> {
        let Roadmap { states, edges } = &self.roadmap;
        let space = self.problem.space();
        let shortest =
            |&[start, goal]: &[usize; 2]| path::shortest(space, states, edges, start, goal);
        let paths = ends.iter().map(shortest).collect();
        let mut account = self.account();
        account.flushing = self.index.flush()?;
        let growth = self.record.finish(self.roadmap.len(), account);
        Ok(AnsweredRoadmap {
            roadmap: self.roadmap,
            paths,
            account,
            growth,
        })
    }
}
