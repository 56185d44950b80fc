//! RRT*: a rapidly exploring random tree that continues after it has found a path, and shortens it.
//!
//! S. Karaman, E. Frazzoli, "Sampling-based algorithms for optimal motion planning", IJRR 30(7), 2011, Algorithm 6 in
//! its k-nearest form: among the k(n) nearest of the n nodes, a new node takes the parent that gives it the shortest
//! path to the root. It then becomes the parent of those whose path to the root it shortens.

use std::{
    cell::Cell,
    collections::HashMap,
    time::{Duration, Instant},
};

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use wayfold::States;

use super::{
    account::Account,
    error::PlanningError,
    figures::{RunRecord, RunTimes},
    options::Source,
    prm_star::k,
    problem::Problem,
    sampling,
    source::{TimedIndex, Usage},
};

/// The maximum length of an extension in resolutions: η.
const MAX_EXTENSION: f64 = 30.0;

/// Until the goal is reached, one in this many samples is the goal.
const GOAL_EVERY: usize = 50;

/// A tree whose nodes store their distance to the root along the tree.
#[derive(Clone, Debug, PartialEq)]
pub struct StarTree {
    /// The nodes' states.
    pub states: States,
    /// The nodes' parents; None for the root.
    pub parents: Vec<Option<usize>>,
    /// The distance of each node to its parent.
    pub lengths: Vec<f64>,
    /// The distance of each node to the root along the tree.
    pub costs: Vec<f64>,
    children: Vec<Vec<usize>>,
    /// The nodes by their ids in the index.
    nodes: HashMap<u64, usize>,
}

impl StarTree {
    /// The number of nodes.
    pub fn len(&self) -> usize {
        self.parents.len()
    }

    fn push(&mut self, state: &[f64], id: u64) -> Result<usize, PlanningError> {
        let node = self.len();
        self.states.push(state)?;
        self.parents.push(None);
        self.lengths.push(0.0);
        self.costs.push(0.0);
        self.children.push(Vec::new());
        self.nodes.insert(id, node);
        Ok(node)
    }

    /// Makes `node` a child of `parent`, and updates all its descendants.
    fn hang(&mut self, node: usize, parent: usize, length: f64) {
        if let Some(before) = self.parents[node] {
            self.children[before].retain(|&child| child != node);
        }
        self.parents[node] = Some(parent);
        self.lengths[node] = length;
        self.children[parent].push(node);
        let mut changed = vec![node];
        while let Some(node) = changed.pop() {
            let parent = self.parents[node].map_or(0.0, |parent| self.costs[parent]);
            self.costs[node] = parent + self.lengths[node];
            changed.extend(&self.children[node]);
        }
    }

    /// The states from the root to a node.
    pub fn branch(&self, node: usize) -> Vec<Vec<f64>> {
        let up = std::iter::successors(Some(node), |&node| self.parents[node]);
        let mut states: Vec<Vec<f64>> = up.map(|node| self.states.row(node).to_vec()).collect();
        states.reverse();
        states
    }
}

/// The progress of a run after some samples.
#[derive(Clone, Copy, Debug)]
pub struct Progress {
    /// The number of drawn states.
    pub samples: usize,
    /// The number of nodes.
    pub nodes: usize,
    /// The length of the path to the goal; infinite if there was none.
    pub cost: f64,
    /// The time up to that moment.
    pub total: Duration,
    /// The part of it in searches and inserts.
    pub neighbors: Usage,
}

/// The result of RRT*.
pub struct Star {
    /// The tree from the start.
    pub tree: StarTree,
    /// The goal's node, if it was reached.
    pub goal: Option<usize>,
    /// The progress at every doubling of the samples, and at the end.
    pub progress: Vec<Progress>,
    /// The numbers of samples after which the path to the goal was found or became shorter, each with its length.
    pub shortened: Vec<(usize, f64)>,
    /// The account of the run's time.
    pub account: Account,
}

impl Star {
    /// The figures of its run.
    pub fn row(&self, source: Source, seed: u64) -> RunRecord {
        let length = self.goal.map(|goal| self.tree.costs[goal]);
        RunRecord {
            planner: "RRT*",
            source: source.name(),
            workers: 1,
            seed,
            nodes: self.tree.len() as u64,
            spent: RunTimes::from(&self.account),
            checks: self.account.checks as u64,
            path_lengths: length.into_iter().collect(),
        }
    }
}

/// Builds a tree from the given number of samples. The same seed gives the same tree with any exact source.
pub fn grow(
    problem: &impl Problem,
    index: TimedIndex,
    seed: u64,
    samples: usize,
) -> Result<Star, PlanningError> {
    let started = Instant::now();
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut planner = Planner::new(problem, index)?;
    let (mut progress, mut next) = (Vec::new(), FIRST);
    let mut shortened: Vec<(usize, f64)> = Vec::new();
    for drawn in 1..=samples {
        let random = sampling::uniform(problem.space(), problem.bounds(), &mut rng);
        let is_for_goal = planner.goal.is_none() && drawn % GOAL_EVERY == 0;
        planner.extend(if is_for_goal { problem.goal() } else { &random })?;
        let tree = &planner.tree;
        let cost = planner.goal.map_or(f64::INFINITY, |node| tree.costs[node]);
        if cost < shortened.last().map_or(f64::INFINITY, |&(_, known)| known) {
            shortened.push((drawn, cost));
        }
        if drawn == next || drawn == samples {
            progress.push(Progress {
                samples: drawn,
                nodes: tree.len(),
                cost,
                total: started.elapsed(),
                neighbors: planner.index.usage(),
            });
            next = drawn * 2;
        }
    }
    let account = Account {
        total: started.elapsed(),
        neighbors: planner.index.usage(),
        checking: planner.checking.get(),
        checks: planner.checks.get() as usize,
        flushing: planner.index.flush()?,
    };
    Ok(Star {
        account,
        tree: planner.tree,
        goal: planner.goal,
        progress,
        shortened,
    })
}

/// The number of samples before the first progress entry.
const FIRST: usize = 125;

struct Planner<'a, P> {
    problem: &'a P,
    index: TimedIndex,
    tree: StarTree,
    goal: Option<usize>,
    /// The time of collision checks, and the number of checked states.
    checking: Cell<Duration>,
    checks: Cell<u64>,
}

/// A near node, and the known facts about the motion to it.
struct NearNode {
    node: usize,
    distance: f64,
    free: Option<bool>,
}

impl<'a, P: Problem> Planner<'a, P> {
    fn new(problem: &'a P, index: TimedIndex) -> Result<Self, PlanningError> {
        let tree = StarTree {
            states: States::new(problem.space().coordinates()),
            parents: Vec::new(),
            lengths: Vec::new(),
            costs: Vec::new(),
            children: Vec::new(),
            nodes: HashMap::new(),
        };
        let mut planner = Planner {
            problem,
            index,
            tree,
            goal: None,
            checking: Cell::default(),
            checks: Cell::default(),
        };
        planner.insert(problem.start())?;
        Ok(planner)
    }

    fn insert(&mut self, state: &[f64]) -> Result<usize, PlanningError> {
        let mut states = States::new(state.len());
        states.push(state)?;
        let ids = self.index.insert(&states)?;
        self.tree.push(state, ids[0])
    }

    /// Extends the tree by one node towards `target` if the motion is free, and rewires it.
    fn extend(&mut self, target: &[f64]) -> Result<(), PlanningError> {
        let Some((nearest, state)) = self.steer(target)? else {
            return Ok(());
        };
        let Some(mut near) = self.around(nearest, &state)? else {
            return Ok(());
        };
        let Some((parent, length)) = self.best_parent(&mut near, &state) else {
            return Ok(());
        };
        let node = self.insert(&state)?;
        self.tree.hang(node, parent, length);
        for mut other in near {
            let by_node = self.tree.costs[node] + other.distance;
            if by_node < self.tree.costs[other.node] && self.is_free_way(&mut other, &state) {
                self.tree.hang(other.node, node, other.distance);
            }
        }
        if state == self.problem.goal() {
            self.goal = Some(node);
        }
        Ok(())
    }

    /// The node nearest to `target`, and the state at the maximum extension towards it; None if that state is not new,
    /// or collides.
    fn steer(&mut self, target: &[f64]) -> Result<Option<(usize, Vec<f64>)>, PlanningError> {
        let Some(nearest) = self.index.nearest(target)? else {
            return Ok(None);
        };
        if nearest.distance == 0.0 {
            return Ok(None);
        }
        let node = self.tree.nodes[&nearest.id];
        let share = MAX_EXTENSION * self.problem.resolution() / nearest.distance;
        let mut state = target.to_vec();
        if share < 1.0 {
            let from = self.tree.states.row(node);
            let space = self.problem.space();
            space.interpolate(from, target, share, &mut state);
        }
        let free = self.check(|checks| {
            *checks += 1;
            self.problem.is_free(&state)
        });
        Ok(free.then_some((node, state)))
    }

    /// The k(n) nearest nodes of `state`; None if the motion to it from `nearest` is not free.
    fn around(
        &mut self,
        nearest: usize,
        state: &[f64],
    ) -> Result<Option<Vec<NearNode>>, PlanningError> {
        let (problem, from) = (self.problem, self.tree.states.row(nearest));
        if !self.check(|checks| problem.is_free_way(from, state, checks)) {
            return Ok(None);
        }
        // k(n) is evaluated here, because no other client inserts. So all sources answer the same plain search.
        let found = self.index.nearest_k(state, k(self.tree.len()))?;
        let near = found.iter().map(|near| {
            let node = self.tree.nodes[&near.id];
            NearNode {
                node,
                distance: near.distance,
                free: (node == nearest).then_some(true),
            }
        });
        Ok(Some(near.collect()))
    }

    /// The node that gives the shortest path from the root to `state`, and its distance to `state`. Candidates are
    /// checked in ascending order of the path's length, so that few motions are checked.
    fn best_parent(&self, near: &mut [NearNode], state: &[f64]) -> Option<(usize, f64)> {
        let cost = |near: &NearNode| self.tree.costs[near.node] + near.distance;
        near.sort_by(|a, b| cost(a).total_cmp(&cost(b)).then(a.node.cmp(&b.node)));
        near.iter_mut().find_map(|near| {
            let free = self.is_free_way(near, state);
            free.then_some((near.node, near.distance))
        })
    }

    fn is_free_way(&self, near: &mut NearNode, state: &[f64]) -> bool {
        let from = self.tree.states.row(near.node);
        let check = || self.check(|checks| self.problem.is_free_way(from, state, checks));
        *near.free.get_or_insert_with(check)
    }

    /// The result of a check, which counts its states.
    fn check(&self, check: impl FnOnce(&mut u64) -> bool) -> bool {
        let (started, mut checks) = (Instant::now(), self.checks.get());
        let free = check(&mut checks);
        self.checks.set(checks);
        self.checking.set(self.checking.get() + started.elapsed());
        free
    }
}
