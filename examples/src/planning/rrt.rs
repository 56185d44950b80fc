//! RRTConCon: two rapidly exploring random trees, each of which connects as far as it can, first towards a random state
//! and then towards the other.
//!
//! J. Kuffner, S. M. LaValle, "RRT-Connect: An Efficient Approach to Single-Query Path Planning", ICRA 2000; this
//! variant is named in S. M. LaValle, J. Kuffner, "Rapidly-Exploring Random Trees: Progress and Prospects", 2001. A
//! connection makes one search, however far it leads, and inserts all its nodes at once.

use std::{
    collections::HashMap,
    time::{Duration, Instant},
};

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use wayfold::States;

use super::{
    account::{Account, Growth, Record},
    comparison::PlannerOutcome,
    error::PlanningError,
    problem::Problem,
    sampling,
    source::TimedIndex,
};

/// One tree. Nodes are numbered from 0; ids are the source's names of the nodes.
#[derive(Clone, Debug, PartialEq)]
pub struct Tree {
    /// The nodes' states.
    pub states: States,
    /// The nodes' parents; None for the root.
    pub parents: Vec<Option<usize>>,
    /// The nodes' ids.
    pub ids: Vec<u64>,
    nodes: HashMap<u64, usize>,
}

impl Tree {
    /// An empty tree, for states of the given number of coordinates.
    pub fn new(coordinates: usize) -> Tree {
        Tree {
            states: States::new(coordinates),
            parents: Vec::new(),
            ids: Vec::new(),
            nodes: HashMap::new(),
        }
    }

    /// The number of nodes.
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// Appends states as a chain: the first is a child of `parent`, each other one a child of its predecessor.
    fn append(
        &mut self,
        mut parent: Option<usize>,
        states: &States,
        ids: Vec<u64>,
    ) -> Result<(), PlanningError> {
        for (state, id) in states.iter().zip(ids) {
            parent = Some(self.push(parent, state, id)?);
        }
        Ok(())
    }

    /// Appends a node, and returns its number.
    pub fn push(
        &mut self,
        parent: Option<usize>,
        state: &[f64],
        id: u64,
    ) -> Result<usize, PlanningError> {
        let node = self.len();
        self.states.push(state)?;
        self.parents.push(parent);
        self.ids.push(id);
        self.nodes.insert(id, node);
        Ok(node)
    }

    /// The node with this id.
    pub fn node(&self, id: u64) -> Option<usize> {
        self.nodes.get(&id).copied()
    }

    /// The states from the root to a node.
    pub fn branch(&self, node: usize) -> Vec<Vec<f64>> {
        let up = std::iter::successors(Some(node), |&node| self.parents[node]);
        let mut states: Vec<Vec<f64>> = up.map(|node| self.states.row(node).to_vec()).collect();
        states.reverse();
        states
    }
}

/// A solved problem.
pub struct Solution {
    /// The tree from the start, and the tree from the goal.
    pub trees: [Tree; 2],
    /// The path from start to goal.
    pub path: Vec<Vec<f64>>,
    /// The account of the time.
    pub account: Account,
    /// The history of the account, in steps of about the same number of nodes.
    pub growth: Vec<Growth>,
}

impl Solution {
    /// The nodes of both trees.
    pub fn nodes(&self) -> usize {
        self.trees.iter().map(Tree::len).sum()
    }
}

impl PlannerOutcome for Solution {
    const PLANNER: &'static str = "RRTConCon";
    const INSERT: &'static str = "all nodes of a connection";

    fn nodes(&self) -> usize {
        self.nodes()
    }

    fn account(&self) -> Account {
        self.account
    }

    fn growth(&self) -> &[Growth] {
        &self.growth
    }

    fn paths(&self) -> impl Iterator<Item = &[Vec<f64>]> {
        [self.path.as_slice()].into_iter()
    }

    fn is_like(&self, other: &Solution) -> bool {
        self.trees == other.trees
    }
}

/// Extends the two trees, an index each, until they meet. The same seed gives the same trees with any exact source.
pub fn solve(
    problem: &impl Problem,
    indices: [TimedIndex; 2],
    seed: u64,
    max_nodes: usize,
) -> Result<Solution, PlanningError> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut planner = Planner::new(problem, indices)?;
    let mut growing = 0;
    loop {
        let random = sampling::uniform(problem.space(), problem.bounds(), &mut rng);
        let other = 1 - growing;
        if let Some(end) = planner.connect(growing, &random)? {
            let target = planner.trees[growing].states.row(end.node).to_vec();
            if let Some(met) = planner.connect(other, &target)?
                && met.reached
            {
                let nodes = if growing == 0 {
                    [end.node, met.node]
                } else {
                    [met.node, end.node]
                };
                return planner.finish(nodes);
            }
        }
        let nodes = planner.nodes();
        if planner.record.is_due(nodes) {
            let account = planner.account();
            planner.record.note(nodes, account);
        }
        if nodes >= max_nodes {
            return Err(PlanningError::Unsolved { nodes });
        }
        growing = other;
    }
}

struct Planner<'a, P> {
    problem: &'a P,
    trees: [Tree; 2],
    indices: [TimedIndex; 2],
    started: Instant,
    checking: Duration,
    checks: usize,
    record: Record,
}

/// The end of a connection.
struct End {
    node: usize,
    /// True if the connection reached its target.
    reached: bool,
}

impl<'a, P: Problem> Planner<'a, P> {
    fn new(problem: &'a P, indices: [TimedIndex; 2]) -> Result<Self, PlanningError> {
        let coordinates = problem.space().coordinates();
        let mut planner = Planner {
            problem,
            trees: [Tree::new(coordinates), Tree::new(coordinates)],
            indices,
            started: Instant::now(),
            checking: Duration::ZERO,
            checks: 0,
            record: Record::new(),
        };
        for (tree, root) in [problem.start(), problem.goal()].into_iter().enumerate() {
            let mut states = States::new(coordinates);
            states.push(root)?;
            planner.insert(tree, None, &states)?;
        }
        Ok(planner)
    }

    fn insert(
        &mut self,
        tree: usize,
        parent: Option<usize>,
        states: &States,
    ) -> Result<(), PlanningError> {
        let ids = self.indices[tree].insert(states)?;
        self.trees[tree].append(parent, states, ids)
    }

    /// Extends a tree from its nearest node towards `target`, until it reaches the target or an obstacle; None if no
    /// node could be added.
    fn connect(&mut self, tree: usize, target: &[f64]) -> Result<Option<End>, PlanningError> {
        let Some(nearest) = self.indices[tree].nearest(target)? else {
            return Ok(None);
        };
        let near = self.trees[tree].nodes[&nearest.id];
        let start = Instant::now();
        let from = self.trees[tree].states.row(near);
        let (problem, checks) = (self.problem, &mut self.checks);
        let (states, reached) = advance(problem, from, target, nearest.distance, checks)?;
        self.checking += start.elapsed();
        if states.is_empty() {
            return Ok(reached.then_some(End {
                node: near,
                reached,
            }));
        }
        self.insert(tree, Some(near), &states)?;
        let node = self.trees[tree].len() - 1;
        Ok(Some(End { node, reached }))
    }

    fn nodes(&self) -> usize {
        self.trees.iter().map(Tree::len).sum()
    }

    fn account(&self) -> Account {
        let [start, goal] = &self.indices;
        Account {
            total: self.started.elapsed(),
            neighbors: start.usage() + goal.usage(),
            checking: self.checking,
            checks: self.checks,
            flushing: Duration::ZERO,
        }
    }

    /// The solution, given the nodes at which the trees meet.
    fn finish(self, [start, goal]: [usize; 2]) -> Result<Solution, PlanningError> {
        let mut account = self.account();
        for index in &self.indices {
            account.flushing += index.flush()?;
        }
        let nodes = self.nodes();
        let growth = self.record.finish(nodes, account);
        let path = path(&self.trees, [start, goal]);
        Ok(Solution {
            trees: self.trees,
            path,
            account,
            growth,
        })
    }
}

/// The states of the nodes on the motion from a free state to `target`, which is at the given distance, up to the first
/// obstacle; true if there is none. Adds the number of checked states.
pub fn advance(
    problem: &impl Problem,
    from: &[f64],
    target: &[f64],
    distance: f64,
    checks: &mut usize,
) -> Result<(States, bool), PlanningError> {
    let space = problem.space();
    let mut states = States::new(space.coordinates());
    let steps = (distance / problem.resolution()).ceil() as usize;
    let mut state = vec![0.0; space.coordinates()];
    for step in 1..=steps {
        space.interpolate(from, target, step as f64 / steps as f64, &mut state);
        *checks += 1;
        if !problem.is_free(&state) {
            return Ok((states, false));
        }
        if step == steps || step % problem.checks_per_node() == 0 {
            states.push(&state)?;
        }
    }
    Ok((states, true))
}

/// The path from the root of the first tree to the root of the second, through one node of each with the same state.
pub fn path(trees: &[Tree; 2], [start, goal]: [usize; 2]) -> Vec<Vec<f64>> {
    let mut path = trees[0].branch(start);
    path.extend(trees[1].branch(goal).into_iter().rev().skip(1));
    path
}
