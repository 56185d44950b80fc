//! Paths: finding one on a roadmap, checking it independently, and shortening it.

use petgraph::{
    algo::astar,
    graph::{NodeIndex, UnGraph},
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold::{Space, States};

use super::{error::PlanningError, problem::Problem};

/// The factor by which the check is finer than the planner's.
const CHECK_FACTOR: f64 = 10.0;

/// Boxes nearer than this touch: for touching boxes, GJK may return a distance of some last bits instead of 0.
pub const TOUCHING: f64 = 1e-9;

/// A problem that can check a motion by code that is independent of the planner's.
pub trait Verify: Problem {
    /// True if the state at the fraction `t` of the motion from `a` to `b` is free. Another library than the planner's
    /// interpolates the state. Another algorithm (GJK, not separating axes) tests every part against every obstacle,
    /// and skips no distant obstacle.
    fn is_free_between(&self, a: &[f64], b: &[f64], t: f64) -> bool;
}

/// The shortest path between two milestones of a roadmap, given the states and the edges of all milestones; None if
/// they are not connected.
pub fn shortest(
    space: &Space,
    states: &States,
    edges: &[Vec<usize>],
    start: usize,
    goal: usize,
) -> Option<Vec<Vec<f64>>> {
    let length = |a: usize, b: usize| space.distance(states.row(a), states.row(b));
    let count = edges.iter().map(Vec::len).sum();
    let mut graph = UnGraph::<(), f64>::with_capacity(edges.len(), count);
    for _ in edges {
        graph.add_node(());
    }
    for (node, to) in edges.iter().enumerate() {
        for &other in to {
            let (from, to) = (NodeIndex::new(node), NodeIndex::new(other));
            graph.add_edge(from, to, length(node, other));
        }
    }
    let (_, nodes) = astar(
        &graph,
        NodeIndex::new(start),
        |node| node.index() == goal,
        |edge| *edge.weight(),
        |node| length(node.index(), goal),
    )?;
    let path = nodes.iter().map(|node| states.row(node.index()).to_vec());
    Some(path.collect())
}

/// Checks a path ten times as finely as the planner did; returns the number of checked states.
pub fn verify(problem: &impl Verify, path: &[Vec<f64>]) -> Result<usize, PlanningError> {
    if let [only] = path {
        let is_free = problem.is_free_between(only, only, 0.0);
        return is_free
            .then_some(1)
            .ok_or(PlanningError::Collision { segment: 0 });
    }
    let mut checked = 0;
    for (segment, pair) in path.windows(2).enumerate() {
        let [a, b] = pair else { continue };
        let distance = problem.space().distance(a, b);
        let steps = (CHECK_FACTOR * distance / problem.resolution())
            .ceil()
            .max(1.0) as usize;
        for step in 0..=steps {
            if !problem.is_free_between(a, b, step as f64 / steps as f64) {
                return Err(PlanningError::Collision { segment });
            }
            checked += 1;
        }
    }
    Ok(checked)
}

/// Shortens a path for the picture: `tries` times, it replaces the part between two random states by the straight
/// motion if that is free. This is no part of the measurement. The result is checked like every path.
pub fn shorten(
    problem: &impl Verify,
    mut path: Vec<Vec<f64>>,
    tries: usize,
    seed: u64,
) -> Result<Vec<Vec<f64>>, PlanningError> {
    eprintln!(
        "shortening a path of {} states for the picture ...",
        path.len()
    );
    let (states, before) = (path.len(), length(problem, &path));
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    for _ in 0..tries {
        if path.len() < 3 {
            break;
        }
        let first = rng.random_range(0..path.len() - 2);
        let last = rng.random_range(first + 2..path.len());
        if problem.is_free_way(&path[first], &path[last], &mut 0) {
            path.drain(first + 1..last);
        }
    }
    let checked = verify(problem, &path)?;
    println!(
        "The picture shows the path of {states} states and the length {before:.2} shortened, to {} and {:.2}, which is free \
         in {checked} states, by other code.",
        path.len(),
        length(problem, &path),
    );
    Ok(path)
}

/// The length of a path in the metric.
pub fn length(problem: &impl Problem, path: &[Vec<f64>]) -> f64 {
    let lengths = path.windows(2).map(|pair| match pair {
        [a, b] => problem.space().distance(a, b),
        _ => 0.0,
    });
    lengths.sum()
}

/// `count` states along a path at equal distances, and its ends.
pub fn spread(problem: &impl Problem, path: &[Vec<f64>], count: usize) -> Vec<Vec<f64>> {
    let space = problem.space();
    let every = length(problem, path) / (count.max(1) as f64);
    let (mut states, mut left) = (Vec::new(), 0.0);
    for pair in path.windows(2) {
        let [a, b] = pair else { continue };
        let distance = space.distance(a, b);
        while left < distance {
            let mut state = vec![0.0; space.coordinates()];
            space.interpolate(a, b, left / distance, &mut state);
            states.push(state);
            left += every;
        }
        left -= distance;
    }
    states.extend(path.last().cloned());
    states
}
