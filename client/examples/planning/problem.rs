//! What a scene tells a planner.

use wayfold_client::Space;

/// A motion planning problem: a way from `start` to `goal` through the free states of a space.
pub trait Problem {
    /// The space, whose metric decides what is near.
    fn space(&self) -> &Space;

    /// The bounds of all real coordinates, in row order; angles and rotations have none.
    fn bounds(&self) -> &[(f64, f64)];

    /// Where to begin, a canonical row.
    fn start(&self) -> &[f64];

    /// Where to arrive, a canonical row.
    fn goal(&self) -> &[f64];

    /// Whether a canonical state is free of collisions.
    fn is_free(&self, state: &[f64]) -> bool;

    /// How far the states may lie apart, in the metric, at which a motion is checked.
    fn resolution(&self) -> f64;

    /// At how many such states a motion gets a node.
    fn checks_per_node(&self) -> usize;
}
