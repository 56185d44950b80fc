//! What a scene tells a planner.

use wayfold::Space;

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

    /// Whether a motion between free states is free: a function of the two, in this order, and of nothing else. Adds how
    /// many states were checked.
    fn is_free_way(&self, a: &[f64], b: &[f64], checks: &mut u64) -> bool {
        let steps = (self.space().distance(a, b) / self.resolution()).ceil() as usize;
        let mut state = vec![0.0; self.space().coordinates()];
        // The middle first, then the middles of the halves: what is in the way is met early.
        let mut stride = steps.next_power_of_two() / 2;
        while stride > 0 {
            for step in (stride..steps).step_by(2 * stride) {
                let share = step as f64 / steps as f64;
                self.space().interpolate(a, b, share, &mut state);
                *checks += 1;
                if !self.is_free(&state) {
                    return false;
                }
            }
            stride /= 2;
        }
        true
    }
}
